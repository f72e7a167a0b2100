"""The second adjustment: bundle adjustment again, on what several views confirm to stand still.

A dynamic object that fills much of the view, or moves along the epipolar lines, has small residuals
and bends the poses. But it is swept to depths on which no two views agree. So confirmation
multiplies the static weight of each cell, and swept depth is the start, of one more final BA.
"""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from minislam.records import Progress, Sequence
from minislam.stereo.dense_structure import WIDTH, dense_depths, swept_frames
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import final_global_ba
from minislam.tracking.reprojection import reproject
from minislam.tracking.safeguards.diagnostics import seen_and_expected
from minislam.tracking.tracker import Tracker
from minislam.tracking.trajectory import pose_frames
from minislam.workers import Workers

# Static weight of a cell that nothing confirms: where no cell is confirmed, all count alike. [-]
UNCONFIRMED_WEIGHT = 0.02
# Relative disagreement of two views of a point that still counts as agreement. [-]
MAX_DISPARITY_ERROR = 0.05
MIN_AGREEING_VIEWS = 2  # other keyframes that must see a point at the same depth
NEIGHBOURS = 4  # keyframes on either side that are compared
COARSE_WIDTH = 80  # px of the images that are swept: a weight per grid cell needs no more


def adjust_again(
    tracker: Tracker,
    sequence: Sequence,
    on_progress: Callable[[str], Progress | None] = lambda stage: None,
    workers: Workers | None = None,  # sweep side by side
) -> None:
    """Adjust the keyframes on what sweeps confirm, and judge them.

    Frames between keyframes are posed and swept as well, to vote. None is called lost here.
    """
    keyframes = [frame.frame_index for frame in tracker.keyframes.frames]
    followed = [frame.frame_index for frame in tracker.tracked if frame.status.is_followed]
    # To pose all frames took two to five times as long, as accurate (diary/dense_structure.md).
    wanted = {*swept_frames(keyframes, followed)}
    chosen = [frame for frame in tracker.tracked if frame.frame_index in wanted]
    poses, _ = pose_frames(tracker.graph, chosen, sequence, on_progress("posing frames"))
    on_sweep, on_round = on_progress("coarse depth"), on_progress("second adjustment")
    inputs = tracker.graph, sequence, poses, sorted(poses), keyframes
    swept = sweep_frames(*inputs, on_sweep, workers, COARSE_WIDTH)
    tracker.watch.confirmed = adjust_confirmed(tracker.graph, swept, on_round)
    tracker.conclude()


def sweep_frames(
    graph: KeyframeGraph,
    sequence: Sequence,
    poses: dict[int, Tensor],  # T_camera_world (4, 4) of what is swept against, by frame index
    frames: list[int],  # that are swept
    wanted: list[int],  # of these, whose depths are returned
    progress: Progress | None = None,
    workers: Workers | None = None,  # sweep side by side
    width: int = WIDTH,  # px of the images that are swept, at most
) -> Iterator[tuple[Tensor, Tensor]]:
    """Return depth (H, W), 0 where unknown, and confirmation (H, W) of each wanted frame."""
    keyframes = [(k, f.frame_index) for k, f in enumerate(graph.keyframes.frames)]
    agreed = {i: agreed_disparities(graph, k).cpu().numpy() for k, i in keyframes if i in poses}
    inputs = graph.grid.camera, poses, agreed, frames, wanted, progress, workers, width
    swept = dense_depths(lambda index: graph.shutter.undone(sequence.frame(index)), *inputs)
    device = graph.grid.rays.device  # the sweep itself runs on the CPU, in OpenCV
    return ((depth.to(device), confirmation.to(device)) for depth, confirmation in swept)


def agreed_disparities(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (n,)
    """Return the disparities of a keyframe on which enough others agree; all, if none is."""
    needed = min(MIN_AGREEING_VIEWS, len(graph.keyframes) - 1)
    agreed = agreeing_views(graph, keyframe) >= needed
    disparities = graph.keyframes.disparities[keyframe]
    return disparities[agreed] if bool(agreed.any()) else disparities


def agreeing_views(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,) int
    """Count for each cell the other keyframes that have its disparity where they see it."""
    near = range(len(graph.keyframes))[max(0, keyframe - NEIGHBOURS) : keyframe + NEIGHBOURS + 1]
    others = [other for other in near if other != keyframe]
    if not others:
        return torch.zeros_like(graph.grid.rays[:, 0], dtype=torch.int64)
    sources = [keyframe] * len(others)
    positions, valid = reproject(*graph.geometry(sources, others))
    seen, expected = seen_and_expected(graph, sources, others, positions.mT)
    visible = valid & graph.grid.camera.contains(positions.mT)
    error = (seen - expected).abs() / expected
    return (visible & (error < MAX_DISPARITY_ERROR)).sum(0)


def adjust_confirmed(
    graph: KeyframeGraph,
    swept: Iterable[tuple[Tensor, Tensor]],  # K x depth (H, W) and confirmation (H, W)
    progress: Progress | None = None,
) -> float:
    """Adjust all keyframes on flow measured anew, each cell weighted by its confirmation.

    Return the fraction of the cells whose swept depth is known.
    """
    keyframes, stride = graph.keyframes, graph.grid.stride
    cells = [torch.stack(images)[:, ::stride, ::stride].flatten(1) for images in swept]
    depth, confirmation = torch.stack(cells, 1)
    keyframes.static_weights *= confirmation.clamp_min(UNCONFIRMED_WEIGHT)
    disparities = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), keyframes.disparities)
    keyframes.set_geometry(keyframes.T_camera_world, disparities)
    final_global_ba(graph, progress)
    return float((depth > 0).float().mean())
