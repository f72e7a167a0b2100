"""What a keyframe costs early and late in a long sequence, and how memory grows: the whole system.

    python -m tests.benchmarks.bench_length [synth:NAME:SEED] [--frames 1600]

One worker, processor seconds. A row per quarter of the frames: tracking and mapping per keyframe
and the memory of the process (Linux); then all stages, and the error.
"""

import argparse
import time
from pathlib import Path
from types import SimpleNamespace

import torch

from minislam.cli.main import set_malloc
from minislam.config import SlamConfig
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.evaluation.metrics import ate_cm
from minislam.priors.choice import PriorChoice
from minislam.runs.run import choose_priors
from minislam.slam import Slam
from minislam.state import steps


def memory() -> str:
    """Return the resident memory now and its peak [MB]."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    now, peak = (int(status.split(key)[1].split()[0]) / 1e3 for key in ("VmRSS:", "VmHWM:"))
    return f"{now:.0f} | {peak:.0f}"


class Quarters(steps.SilentObserver):
    """Prints a row after every quarter of the frames."""

    slam: Slam

    def __init__(self) -> None:
        self.before: dict[str, float] = {}
        self.known = 0  # keyframes by then

    def show(self, stage: str, done: int, total: int) -> None:
        """Print what the keyframes since the last row have cost."""
        if stage != "tracking and mapping" or done * 4 % total >= 4:
            return
        seconds, known = dict(self.slam.steps.seconds), len(self.slam.tracker.keyframes)
        costs = [
            (seconds.get(name, 0) - self.before.get(name, 0)) / max(1, known - self.known)
            for name in ("tracking", "mapping")
        ]
        print(f"| {done} | {known} | {costs[0]:.2f} | {costs[1]:.2f} | {memory()} |", flush=True)
        self.before, self.known = seconds, known


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", nargs="?", default="synth:loop:4711")
    parser.add_argument("--frames", type=int, default=1600)
    given = parser.parse_args()
    torch.set_num_threads(1)
    steps.time = SimpleNamespace(perf_counter=time.process_time)
    set_malloc()  # as the command does
    sequence = open_sequence(given.name, InputOptions(max_frames=given.frames))
    config, quarters = SlamConfig(), Quarters()
    priors = choose_priors(PriorChoice(depth="simulated"), sequence, config)
    slam = quarters.slam = Slam(sequence, config, priors, quarters)
    print("| frames | keyframes | tracking | mapping [s per keyframe] | MB | peak MB |")
    print("|---|---|---|---|---|---|")
    slam.run()
    count, seconds = len(slam.tracker.keyframes), slam.steps.seconds
    for stage in list(seconds):
        print(f"{stage}: {seconds[stage]:.0f} s, {seconds[stage] / count:.2f} per keyframe")
    truth = sequence.ground_truth
    if truth is not None and truth.trajectory is not None:
        print(f"ATE of all frames {ate_cm(slam.trajectory(), truth.trajectory):.3f} cm")
    print(f"{len(slam.mapper.gaussians)} Gaussians; memory now | peak {memory()} MB")


if __name__ == "__main__":
    main()
