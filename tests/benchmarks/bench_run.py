"""Time the whole command with one worker and with two, and compare what it computes.

    python -m tests.benchmarks.bench_run [--sequences synth:ball:61,...] [--frames 100]
                                         [--workers 1,2] [--repeats 3] [-- OPTIONS OF minislam run]

The runs take turns, so that a busy hour meets all of them; medians are printed. Wall seconds mean
something on an idle machine only, processor seconds and ratios a little more. The files of a
sequence must have the same bytes with every number of workers.
"""

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SEQUENCES = "synth:ball:61,synth:crowd:61,synth:table2:61"
COMPARED = ("trajectory.txt", "keyframe_trajectory.txt", "map.ply", "uncertainty_mlp.pt")
METRICS = ("psnr_novel_db", "ate_keyframes_cm", "ate_all_cm")


def run_once(
    sequence: str, frames: int, workers: int, options: list[str], output: Path
) -> dict[str, float]:
    """Run the command; return wall and processor seconds, and the seconds per stage."""
    command = [sys.executable, "-m", "minislam", "run", sequence, "-q", "-o", str(output)]
    command += ["--overwrite", "--max-frames", str(frames), "--workers", str(workers), *options]
    before, start = os.times(), time.perf_counter()
    subprocess.run(command, check=True)
    wall, after = time.perf_counter() - start, os.times()
    processor = after.children_user - before.children_user
    processor += after.children_system - before.children_system
    stages = json.loads((output / "run.json").read_text(encoding="utf-8"))["seconds"]
    return {"wall": wall, "processor": processor, **stages}


def fingerprint(folder: Path) -> str:
    """Return a hash of what a run computes."""
    digest = hashlib.sha256()
    for name in COMPARED:
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Print one table per sequence."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", default=SEQUENCES)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("options", nargs="*")
    args = parser.parse_args()
    counts = [int(word) for word in args.workers.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        for sequence in args.sequences.split(","):
            output = {count: Path(folder) / f"{count}" for count in counts}
            times: dict[int, list[dict[str, float]]] = {count: [] for count in counts}
            for _ in range(args.repeats):
                for count in counts:
                    seconds = run_once(sequence, args.frames, count, args.options, output[count])
                    times[count].append(seconds)
            print_table(sequence, args.frames, times)
            metrics = json.loads((output[counts[0]] / "metrics.json").read_text(encoding="utf-8"))
            print("; ".join(f"{name} {metrics[name]:.3f}" for name in METRICS))
            same = len({fingerprint(output[count]) for count in counts}) == 1
            print("the same bytes" if same else "DIFFERENT BYTES")


def print_table(sequence: str, frames: int, times: dict[int, list[dict[str, float]]]) -> None:
    """Print the median seconds per stage, and the ratio of the first column to each other one."""
    print(
        f"\n| {sequence}, {frames} frames | {' | '.join(f'{n} workers' for n in times)} | ratio |"
    )
    print("|---|" + "---|" * (len(times) + 1))
    for stage in next(iter(times.values()))[0]:
        medians = [statistics.median(run[stage] for run in runs) for runs in times.values()]
        ratios = ", ".join(f"{medians[0] / max(m, 1e-9):.2f}" for m in medians[1:])
        print(f"| {stage} | {' | '.join(f'{m:.1f}' for m in medians)} | {ratios} |", flush=True)


if __name__ == "__main__":
    main()
