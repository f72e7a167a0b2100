"""What a keyframe costs the tracker early and late in a long sequence, and how memory grows.

    python -m tests.benchmarks.bench_length [NAME:SEED] [--frames 1600] [--size 160x120]

Tracking alone, with the simulated depth prior, one thread: processor seconds per keyframe and
resident memory after every eighth of the frames (Linux), then the final adjustment.
"""

import argparse
import time
from pathlib import Path

import torch

from minislam.config import SlamConfig
from minislam.data import InputOptions, open_sequence
from minislam.priors.choice import PriorChoice
from minislam.runs.run import choose_priors
from minislam.tracking.tracker import Tracker


def memory() -> str:
    """Return the resident memory now and its peak [MB]."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    now, peak = (int(status.split(key)[1].split()[0]) / 1e3 for key in ("VmRSS:", "VmHWM:"))
    return f"{now:.0f} | {peak:.0f}"


def main() -> None:
    """Print one row per eighth."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name", nargs="?", default="loop:4711")
    parser.add_argument("--frames", type=int, default=1600)
    parser.add_argument("--size", default="160x120")
    given = parser.parse_args()
    torch.set_num_threads(1)
    width, height = map(int, given.size.split("x"))
    options = InputOptions(max_frames=given.frames, size=(width, height))
    sequence = open_sequence(f"synth:{given.name}", options)
    config = SlamConfig()
    priors = choose_priors(PriorChoice(depth="simulated"), sequence, config)
    parts = config.tracking, priors.flow, priors.features, priors.depth
    tracker = Tracker(sequence.camera, *parts, lambda index: torch.ones(tracker.grid.shape))
    print("| frames | keyframes | links | s per keyframe | MB | peak MB |")
    print("|---|---|---|---|---|---|")
    start, before = time.process_time(), 0
    for index in range(len(sequence)):
        is_new, count = tracker.track(sequence.frame(index)), len(tracker.keyframes)
        if is_new and not tracker.initialised and count >= config.tracking.warmup_keyframes:
            tracker.initialise()
            tracker.refine_initialisation()
        if (index + 1) % max(1, len(sequence) // 8) == 0:
            cost = (time.process_time() - start) / max(1, count - before)
            links = len(tracker.graph.links)
            print(f"| {index + 1} | {count} | {links} | {cost:.2f} | {memory()} |", flush=True)
            start, before = time.process_time(), count
    tracker.end()
    tracker.finish()
    cost = (time.process_time() - start) / len(tracker.keyframes)
    count, links = len(tracker.keyframes), len(tracker.graph.links)
    print(f"| final | {count} | {links} | {cost:.2f} | {memory()} |")


if __name__ == "__main__":
    main()
