"""Poses of the frames between the keyframes."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate
from minislam.records import Sequence
from minislam.tracking.bundle_adjustment import BundleState, motion_only_adjust
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import motion_only_problem, start_pose
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.tracker import Tracker

ITERATIONS = 8  # Gauss-Newton steps of six unknowns
ROBUST_NARROWING = 0.5  # of the robust scale, because the structure is known by now [-]


def pose_all_frames(
    tracker: Tracker, sequence: Sequence, progress: Callable[[int, int], None] | None = None
) -> dict[int, Tensor]:
    """Return T_camera_world (4, 4) of every frame that was not lost, by frame index.

    A keyframe keeps its pose. Another frame starts from the interpolated pose and is adjusted on
    the flow from the keyframe before it and the keyframe after it. Their disparities are held.
    """
    frames, known = tracker.keyframes.frames, tracker.keyframes.T_camera_world
    poses = {frame.frame_index: T for frame, T in zip(frames, known, strict=True)}
    others = [t for t in tracker.tracked if t.status.is_followed and t.frame_index not in poses]
    for done, tracked in enumerate(others):
        following = sum(f.frame_index < tracked.frame_index for f in frames)
        around = [following - 1]
        if following < len(frames) and not tracker.graph.follows_a_loss(following):
            around.append(following)
        image = sequence.frame(tracked.frame_index).image
        poses[tracked.frame_index] = _pose_between(tracker.graph, around, tracked.timestamp, image)
        if progress:
            progress(done + 1, len(others))
    return dict(sorted(poses.items()))


def _pose_between(
    graph: KeyframeGraph, around: list[int], timestamp: float, image: Tensor
) -> Tensor:
    """Return T_camera_world (4, 4) of a frame after one keyframe or between two."""
    keyframes, grid = graph.keyframes, graph.grid
    known = keyframes.T_camera_world[around]
    start = known[0]
    if len(around) == 2:
        first, second = (keyframes.frames[k].timestamp for k in around)
        start = se3_interpolate(known[0], known[1], (timestamp - first) / (second - first))
    newest, count = len(keyframes), len(around)
    poses = torch.cat([known, start[None]])
    disparities = keyframes.disparities[around]
    sources, targets = torch.arange(count), torch.full((count,), count)

    transforms = relative_transforms(poses, sources, targets).float()
    predicted, _ = reproject(transforms, disparities, grid.rays, grid.camera)
    graph.flow.add_frame(newest, image)
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
    if count == 1:
        # No later keyframe constrains the pose, so it may follow a dynamic object: two starts.
        starts = [start, _extrapolate_pose(graph, around[0], timestamp)]
        poses[-1] = start_pose(
            grid, matches, disparities[0], cell_weights[0], known[0], starts, graph.robust
        )
    unused = torch.zeros(1, len(grid.rays))  # disparities of the frame itself
    state = BundleState(poses, torch.cat([disparities, unused]))
    state, report = motion_only_adjust(problem, state, ITERATIONS)
    graph.count_adjustment(report)
    return state.T_camera_world[-1]


def _extrapolate_pose(graph: KeyframeGraph, keyframe: int, timestamp: float) -> Tensor:
    """Extrapolate the motion up to a keyframe; return the pose (4, 4) at a later time."""
    before = max(keyframe - 1, 0)
    poses, frames = graph.keyframes.T_camera_world, graph.keyframes.frames
    elapsed = frames[keyframe].timestamp - frames[before].timestamp
    fraction = (timestamp - frames[before].timestamp) / elapsed if elapsed > 0 else 1.0
    return se3_interpolate(poses[before], poses[keyframe], fraction)
