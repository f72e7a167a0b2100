"""Poses of the frames between the keyframes."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate
from minislam.records import Sequence, TrackedFrame, TrackingStatus
from minislam.tracking.bundle_adjustment import BundleState, motion_only_adjust, residuals
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import motion_only_problem, start_pose
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards.pose_support import PoseFit, retry_doubtful
from minislam.tracking.tracker import Tracker

ITERATIONS = 8  # Gauss-Newton steps of six unknowns
ROBUST_NARROWING = 0.5  # of the robust scale, because the structure is known by now [-]


def pose_all_frames(
    tracker: Tracker, sequence: Sequence, progress: Callable[[int, int], None] | None = None
) -> dict[int, Tensor]:
    """Return T_camera_world (4, 4) of every frame that was not lost, by frame index.

    A keyframe keeps its pose. Another frame starts from the interpolated pose and is adjusted on
    the flow from the keyframes around it, whose disparities are held. A pose that little of the
    flow supports starts again from its neighbours; a frame that stays without support is lost.
    """
    graph, frames = tracker.graph, tracker.keyframes.frames
    poses = tracker.keyframes.T_camera_world
    fits = {f.frame_index: PoseFit(T, 1.0) for f, T in zip(frames, poses, strict=True)}
    followed = [t for t in tracker.tracked if t.status.is_followed]
    others = {t.frame_index: t for t in followed if t.frame_index not in fits}

    def fit_from(index: int, start: Tensor) -> PoseFit:
        return _fit_pose(graph, sequence, others[index], start)

    for done, (index, tracked) in enumerate(others.items()):
        fits[index] = fit_from(index, _interpolate(graph, tracked))
        if progress:
            progress(done + 1, len(others))
    lost = retry_doubtful(fits, list(others), fit_from)
    for position, tracked in enumerate(tracker.tracked):
        if tracked.frame_index in lost:
            tracker.tracked[position] = replace(tracked, status=TrackingStatus.LOST)
    return {index: fits[index].T_camera_world for index in sorted(fits)}


def _around(graph: KeyframeGraph, tracked: TrackedFrame) -> list[int]:
    """Return the keyframes before and after a frame; one, if the camera was lost between them."""
    frames = graph.keyframes.frames
    following = sum(frame.frame_index < tracked.frame_index for frame in frames)
    is_between = following < len(frames) and not graph.follows_a_loss(following)
    return [following - 1, following] if is_between else [following - 1]


def _interpolate(graph: KeyframeGraph, tracked: TrackedFrame) -> Tensor:  # (4, 4)
    """Interpolate the pose by timestamp between two keyframes; after one, return its pose."""
    around = _around(graph, tracked)
    known = graph.keyframes.T_camera_world[around]
    if len(around) == 1:
        return known[0]
    first, second = (graph.keyframes.frames[k].timestamp for k in around)
    return se3_interpolate(known[0], known[1], (tracked.timestamp - first) / (second - first))


def _fit_pose(
    graph: KeyframeGraph, sequence: Sequence, tracked: TrackedFrame, start: Tensor
) -> PoseFit:
    """Estimate the pose of a frame from a start (4, 4)."""
    keyframes, grid = graph.keyframes, graph.grid
    around = _around(graph, tracked)
    known = keyframes.T_camera_world[around]
    newest, count = len(keyframes), len(around)
    poses = torch.cat([known, start[None]])
    disparities = keyframes.disparities[around]
    sources, targets = torch.arange(count), torch.full((count,), count)

    transforms = relative_transforms(poses, sources, targets).float()
    predicted, _ = reproject(transforms, disparities, grid.rays, grid.camera)
    graph.flow.add_frame(newest, sequence.frame(tracked.frame_index).image)
    matches = graph.flow.match(around, [newest] * count, predicted)
    graph.flow.remove_frame(newest)

    cell_weights = keyframes.cell_weights[around]
    problem = motion_only_problem(
        grid,
        sources,
        targets,
        matches.targets,
        matches.confidences * cell_weights[:, None],
        free_poses=torch.arange(count + 1) == count,
        robust=graph.robust and graph.robust.widened(ROBUST_NARROWING),
    )
    if count == 1:  # no later keyframe constrains the pose, so it may follow a dynamic object
        weights, robust = cell_weights[0], graph.robust
        poses[-1] = start_pose(grid, matches, disparities[0], weights, known[0], [start], robust)
    unused = torch.zeros(1, len(grid.rays))  # disparities of the frame itself
    state = BundleState(poses, torch.cat([disparities, unused]))
    state, report = motion_only_adjust(problem, state, ITERATIONS)
    graph.count_adjustment(report)
    _, final_weights = residuals(problem, state)
    return PoseFit(state.T_camera_world[-1], float(final_weights.mean()))
