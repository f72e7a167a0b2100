"""Run the whole system on synthetic clips, with and without beta and a depth prior: three tables.

    python -m tests.benchmarks.bench_synthetic FOLDER [--seeds 201,202] [--jobs 2]

Every clip with every seed is run three times, `minislam run synth:NAME:SEED --max-frames 100
--workers 1` with the options of MODES, each into its own folder in FOLDER: 33 runs a seed, some 90
processor seconds each. What FOLDER holds already is not run again, so another commit needs
another FOLDER. Means over the seeds are printed, as Markdown, and which runs ended otherwise than
finished and with all frames.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

from tests.benchmarks.bench_movers import SEQUENCES

MODES = {
    "a simulated depth network": ["--depth", "simulated"],
    "the same without beta": ["--depth", "simulated", "--no-uncertainty"],
    "images alone": ["--depth", "none"],
}
COLUMNS = {  # heading: the metric, its decimals
    "ATE all frames [cm]": ("ate_all_cm", 2),
    "ATE keyframes [cm]": ("ate_keyframes_cm", 2),
    "PSNR novel [dB]": ("psnr_novel_db", 1),
    "oriented [dB]": ("psnr_novel_oriented_db", 1),
    "input [dB]": ("psnr_input_db", 1),
    "behind movers [dB]": ("psnr_masked_db", 1),
    "AUROC of beta": ("beta_auroc", 3),
    "depth L1 [cm]": ("depth_l1_cm", 1),
}
Run = tuple[str, str, int]  # mode, clip, seed


def place(folder: Path, run: Run) -> Path:
    """Return the folder of one run."""
    mode, clip, seed = run
    return folder / mode.replace(" ", "_") / f"{clip}_{seed}"


def run_once(folder: Path, run: Run) -> None:
    """Run the command, unless its folder has metrics; its output goes beside them."""
    mode, clip, seed = run
    output = place(folder, run)
    if (output / "metrics.json").exists():
        return
    output.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "minislam", "run", f"synth:{clip}:{seed}", "--max-frames"]
    command += ["100", "--workers", "1", "-o", str(output), "--overwrite", *MODES[mode]]
    with open(f"{output}.log", "w", encoding="utf-8") as log:
        subprocess.run(command, stdout=log, stderr=log, check=False)


def read(folder: Path, run: Run, name: str) -> Any:
    """Return what a JSON file of a run holds; an empty dict if the run left none."""
    path = place(folder, run) / name
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def cell(values: Iterable[float | None], decimals: int) -> tuple[float | None, str]:
    """Return the mean of what was measured, and how it is printed: - if nothing was."""
    known = [value for value in values if value is not None]
    return (fmean(known), f"{fmean(known):.{decimals}f}") if known else (None, "-")


def print_table(folder: Path, mode: str, seeds: list[int]) -> None:
    """Print the means of all clips, their mean over the clips with movers, and the worst run."""
    print(f"\n{mode}:\n\n| clip | {' | '.join(COLUMNS)} |\n|{'---|' * (len(COLUMNS) + 1)}")
    found: dict[str, list[float]] = {heading: [] for heading in COLUMNS}
    worst = (0.0, "")
    for clip in SEQUENCES:
        metrics = [read(folder, (mode, clip, seed), "metrics.json") for seed in seeds]
        row = []
        for heading, (name, decimals) in COLUMNS.items():
            mean, text = cell([each.get(name) for each in metrics], decimals)
            row.append(text)
            if mean is not None and clip != "static":
                found[heading].append(mean)
        print(f"| {clip} | {' | '.join(row)} |")
        for seed, each in zip(seeds, metrics, strict=True):
            worst = max(worst, (each.get("ate_keyframes_cm") or 0.0, f"{clip}:{seed}"))
    means = [
        f"{fmean(values):.{COLUMNS[heading][1]}f}" if values else "-"
        for heading, values in found.items()
    ]
    print(f"| mean of those with movers | {' | '.join(means)} |")
    print(f"\nworst over keyframes: {worst[1]}, {worst[0]:.2f} cm")


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="201,202")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    seeds = [int(word) for word in args.seeds.split(",")]
    runs = [(mode, clip, seed) for seed in seeds for mode in MODES for clip in SEQUENCES]
    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(lambda run: run_once(args.folder, run), runs))
    for mode in MODES:
        print_table(args.folder, mode, seeds)
    for run in runs:
        facts = read(args.folder, run, "run.json")
        ended = (facts.get("state"), facts.get("exit_code"), facts.get("lost_frames"))
        if ended != ("finished", 0, 0):
            print(f"{place(args.folder, run)}: state, exit code, lost frames {ended}")


if __name__ == "__main__":
    main()
