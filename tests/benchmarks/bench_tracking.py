"""Time the hot paths of tracking on one thread: the bundle adjustment and the flow.

    python -m tests.benchmarks.bench_tracking

Times are processor time, medians; the ratio to the dense normal equations is what a busy machine
does not change.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from unittest import mock

import torch

from data_synth import generate
from minislam.geometry import Camera, se3_exp
from minislam.priors import flow as classical
from minislam.priors.depth import SensorDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame
from minislam.tracking.bundle_adjustment import bundle_adjust
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.config import TrackingConfig
from minislam.tracking.grid import Grid
from minislam.tracking.reference import dense_step
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.tracking.tracker import Tracker

CAMERA = Camera(272.0, 272.0, 160.0, 120.0, 320, 240)
STRIDE = 8
REPEATS = 7
LOOP_FRAMES, LOOP_SIZE = 400, (160, 120)
STEP = (0.02, 0.005, 0.01, 0.001, -0.003, 0.002)  # twist from keyframe to keyframe


def milliseconds(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median processor time of a call."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times)


def problem(
    keyframes: int, edges: int, camera: Camera = CAMERA, dtype: torch.dtype = torch.float32
) -> tuple[BundleProblem, BundleState]:
    """Return a problem of neighbouring keyframes with noisy flow, and a state that is near."""
    grid, source = Grid.of(camera, STRIDE), torch.Generator().manual_seed(0)
    cells = len(grid.rays)
    poses = se3_exp(torch.arange(keyframes)[:, None] * torch.tensor(STEP, dtype=torch.float64))
    disparities = 0.2 + 0.3 * torch.rand(keyframes, cells, generator=source, dtype=dtype)
    near = [
        (i, j)
        for radius in range(1, keyframes)
        for i in range(keyframes)
        for j in (i - radius, i + radius)
        if 0 <= j < keyframes
    ][:edges]
    sources, targets = (torch.tensor(ends) for ends in zip(*near, strict=True))
    rays = grid.rays.to(dtype)
    transforms = relative_transforms(poses, sources, targets).to(dtype)
    positions, _ = reproject(transforms, disparities[sources], rays, camera)
    noise = torch.randn(positions.shape, generator=source, dtype=dtype)
    nothing = torch.zeros_like(disparities)
    made = BundleProblem(
        camera=camera,
        rays=rays,
        edges_source=sources,
        edges_target=targets,
        targets=positions + noise,
        weights=torch.ones_like(positions),
        prior_disparities=nothing,
        prior_weights=nothing,
        free_poses=torch.arange(keyframes) > 0,
        free_disparities=torch.ones(keyframes, dtype=torch.bool),
        robust=RobustKernel(1.0),
    )
    return made, BundleState(poses, 1.02 * disparities)


def bench_bundle_adjustment() -> None:
    """Print the time of one Gauss-Newton iteration."""
    for keyframes, edges in ((8, 30), (80, 480)):
        made, state = problem(keyframes, edges)
        once = milliseconds(partial(bundle_adjust, made, state, 0))
        # Each iteration linearises once more: at the state it has reached.
        twice = milliseconds(partial(bundle_adjust, made, state, 1))
        print(f"BA, {edges} edges, {keyframes} keyframes, 30x40 cells: {twice - once:.1f} ms")
    small = Camera(40.0, 40.0, 24.0, 16.0, 48, 32)
    made, state = problem(4, 12, small, torch.float64)
    ours = milliseconds(lambda: bundle_adjust(made, state, 1))
    dense = milliseconds(lambda: dense_step(made, state, 1e-4, 1e-6), repeats=3)
    print(f"dense normal equations against ours, 12 edges of 4x6 cells: {dense / ours:.0f} times")


def bench_flow() -> None:
    """Print the time of the flow of one edge, and of one step of the chain."""
    clip = generate("static", seed=0, frames=5)
    images = [torch.from_numpy(image) for image in clip.rgb]
    flow = ClassicalFlow()
    for index in (0, 4):
        flow.add_frame(index, images[index])
    still = CAMERA.pixel_grid(STRIDE).flatten(0, 1).T[None]
    with mock.patch.object(classical, "START_TOLERANCE", 0.0):  # nothing is remembered
        edge = milliseconds(lambda: flow.match([0], [4], still))
    chain = flow.start_chain(images[0])
    step = milliseconds(lambda: chain.advance(images[1]))
    print(f"flow at 320x240: {edge:.0f} ms per edge, {step:.0f} ms per frame of the chain")


def bench_keyframes() -> None:
    """Print the time of a keyframe early and late in a long sequence, without global BAs."""
    clip = generate("loop", seed=0, frames=LOOP_FRAMES, size=LOOP_SIZE)
    k = clip.intrinsics
    camera = Camera(k.fx, k.fy, k.cx, k.cy, *LOOP_SIZE)
    cells = Grid.of(camera, STRIDE).shape
    tracker = Tracker(
        camera,
        TrackingConfig(global_interval=0),
        ClassicalFlow(),
        ClassicalFeatures(),
        SensorDepth(lambda index: clip.depth[index]),
        lambda keyframe_index: torch.ones(cells),
    )
    times: list[float] = []
    for index, image in enumerate(clip.rgb):
        frame = Frame(index, float(clip.timestamps[index]), torch.from_numpy(image))
        start = time.process_time()
        was_initialised = tracker.initialised
        has_new_keyframes = tracker.track(frame)
        elapsed = time.process_time() - start
        if has_new_keyframes and was_initialised:
            times.append(1e3 * elapsed)
        if not tracker.initialised and len(tracker.keyframes) == tracker.config.warmup_keyframes:
            tracker.initialise()
            tracker.refine_initialisation()
    quarter = len(times) // 4
    early, late = statistics.median(times[:quarter]), statistics.median(times[-quarter:])
    print(
        f"one keyframe at {LOOP_SIZE[0]}x{LOOP_SIZE[1]}: {early:.0f} ms in the first quarter, "
        f"{late:.0f} ms in the last of {len(tracker.keyframes)} keyframes"
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    bench_bundle_adjustment()
    bench_flow()
    bench_keyframes()
