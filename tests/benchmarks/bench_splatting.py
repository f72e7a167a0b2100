"""Time the renderer, forward and backward, and compare it with plain autograd renderers.

    python -m tests.benchmarks.bench_splatting [--threads 1] [--repeats 15] [--plot timings.png]
    python -m tests.benchmarks.bench_splatting --device cuda  # our own renderer alone

All contestants take turns in one process, so that a busy machine slows them all alike: the
ratios mean more than the milliseconds. The dense reference runs only on a small scene.
"""

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.splatting import GaussianMap, render, render_reference
from tests.benchmarks.room import room_camera, room_scene
from tests.benchmarks.tile_autograd import render_tiles_with_autograd

SIZES = ((160, 120, 5_000), (320, 240, 20_000), (640, 480, 50_000))  # width, height, Gaussians
COMPARED = (320, 240, 20_000)
DENSE = (40, 30, 400)  # every Gaussian at every pixel: larger scenes do not fit into memory
AUTOGRAD_REPEATS = 3  # seconds each
# Between float32 renderers: Gaussians on a wall nearly tie in depth, and a swap changes both.
TOLERANCE = 5e-2


class Case:
    """A scene with everything requiring a gradient, and fixed image gradients."""

    def __init__(self, width: int, height: int, count: int, device: str = "cpu") -> None:
        self.name = f"{width}x{height} / {count}"
        self.camera: Camera = room_camera(width, height)
        gaussians, pose = room_scene(self.camera, count, seed=0)
        leaves = [p.to(device).requires_grad_() for p in gaussians.parameters.values()]
        self.gaussians = GaussianMap(*leaves, gaussians.anchor_keyframe.to(device))
        self.pose, self.twist = pose.to(device), torch.zeros(6, device=device, requires_grad=True)
        self.leaves = [*leaves, self.twist]
        source = torch.Generator().manual_seed(1)
        shapes = [(height, width, 3), (height, width), (height, width)]
        self.cotangents = [torch.randn(shape, generator=source).to(device) for shape in shapes]

    def time(self, renderer: Callable) -> tuple[float, float, list[Tensor]]:
        """Return seconds of forward and backward, and the gradients."""
        start = self._now()
        images = renderer(self.gaussians, self.camera, self.pose, twist=self.twist)[:3]
        middle = self._now()
        gradients = torch.autograd.grad(images, self.leaves, self.cotangents)
        return middle - start, self._now() - middle, list(gradients)

    def _now(self) -> float:
        if self.twist.is_cuda:
            torch.cuda.synchronize()
        return time.perf_counter()


def median_ms(seconds: list[float]) -> float:
    """Return the median in milliseconds."""
    return 1e3 * statistics.median(seconds)


def time_sizes(repeats: int, device: str = "cpu") -> list[tuple[str, float, float]]:
    """Return (name, forward ms, backward ms) at each size, the sizes taking turns."""
    cases = [Case(*size, device) for size in SIZES]
    times = {case.name: ([], []) for case in cases}
    for repeat in range(repeats + 2):
        for case in cases:
            forward, backward, _ = case.time(render)
            if repeat >= 2:  # the first two fill caches
                times[case.name][0].append(forward)
                times[case.name][1].append(backward)
    return [(name, median_ms(f), median_ms(b)) for name, (f, b) in times.items()]


def compare(size: tuple[int, int, int], other: Callable, repeats: int) -> tuple[float, float]:
    """Return the median ms of `render` and of `other`, after checking that they agree."""
    case = Case(*size)
    ours, theirs = [], []
    for _ in range(repeats):
        for _ in range(3):
            forward, backward, gradients = case.time(render)
            ours.append(forward + backward)
        forward, backward, other_gradients = case.time(other)
        theirs.append(forward + backward)
    for one, two in zip(gradients, other_gradients, strict=True):
        difference = float((one - two).norm() / two.norm())
        assert difference < TOLERANCE, f"the two renderers disagree by {difference:.1e}"
    return median_ms(ours), median_ms(theirs)


def peak_memory_mb() -> float:
    """Return by how much rendering raises the peak memory at the largest size [MB]."""
    command = [sys.executable, "-m", "tests.benchmarks.bench_splatting", "--memory-only"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory() -> float:
    """Return the same, in the process of its own that peak figures need."""
    small, large = Case(*SIZES[0]), Case(*SIZES[-1])
    small.time(render)  # what torch allocates once
    before = _peak_kilobytes()
    for _ in range(3):
        large.time(render)
    return (_peak_kilobytes() - before) / 1024


def _peak_kilobytes() -> int:
    # Not resource.getrusage: its maximum is inherited from the process that started this one.
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1])
    raise InputError("expected VmHWM in /proc/self/status; peak memory needs Linux")


def save_plot(rows: list[tuple[str, float, float]], path: str) -> None:
    """Save a bar chart of the timings."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    names = [row[0] for row in rows]
    axes.barh(names, [row[1] for row in rows], label="forward")
    axes.barh(names, [row[2] for row in rows], left=[row[1] for row in rows], label="backward")
    axes.set_xlabel("time per iteration [ms]")
    axes.legend()
    figure.savefig(path)


def main() -> None:
    """Print the table, and save the plot if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--plot", help="path of the bar chart to save")
    parser.add_argument("--memory-only", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.memory_only:
        print(measure_memory())
        return

    rows = time_sizes(arguments.repeats, arguments.device)
    print(f"{arguments.device}, {arguments.threads} thread(s), medians of {arguments.repeats}")
    print(f"{'scene':<18} {'forward':>9} {'backward':>9} {'total':>9}  ms")
    for name, forward, backward in rows:
        print(f"{name:<18} {forward:9.1f} {backward:9.1f} {forward + backward:9.1f}")
    if arguments.device != "cpu":
        return
    for label, size, other in (
        ("per-tile autograd, 16 px", COMPARED, render_tiles_with_autograd),
        ("dense reference", DENSE, render_reference),
    ):
        ours, theirs = compare(size, other, AUTOGRAD_REPEATS)
        scene = f"{size[0]}x{size[1]} / {size[2]}"
        print(f"{label} at {scene}: {theirs:.1f} ms, ours {ours:.1f} ms, {theirs / ours:.1f} x")
    print(f"peak memory over the baseline at {rows[-1][0]}: {peak_memory_mb():.0f} MB")
    if arguments.plot:
        save_plot(rows, arguments.plot)


if __name__ == "__main__":
    main()
