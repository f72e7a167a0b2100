"""Poses of the frames between the keyframes."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate
from minislam.records import Sequence
from minislam.tracking.backend import BackEnd
from minislam.tracking.bundle_adjustment import BundleProblem, BundleState, motion_only_adjust
from minislam.tracking.initialisation import start_pose
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.tracker import Tracker

ITERATIONS = 8  # Gauss-Newton steps of six unknowns
ROBUST_NARROWING = 0.5  # the structure is known by now: a narrower robust weight [-]


def pose_all_frames(
    tracker: Tracker, sequence: Sequence, progress: Callable[[int, int], None] | None = None
) -> dict[int, Tensor]:
    """Return T_camera_world (4, 4) of every frame that was not lost, by frame index.

    A keyframe keeps its pose. Another frame starts from the interpolated one and is adjusted on
    the flow from the keyframe before and the keyframe after it, their structure held.
    """
    frames, known = tracker.keyframes.frames, tracker.keyframes.T_camera_world
    poses = {frame.frame_index: T for frame, T in zip(frames, known, strict=True)}
    others = [t for t in tracker.tracked if t.status.is_followed and t.frame_index not in poses]
    for done, tracked in enumerate(others):
        following = sum(f.frame_index < tracked.frame_index for f in frames)
        around = [following - 1]
        if following < len(frames) and not tracker.follows_a_loss(following):
            around.append(following)
        image = sequence.frame(tracked.frame_index).image
        poses[tracked.frame_index] = _pose_between(
            tracker.backend, around, tracked.timestamp, image
        )
        if progress:
            progress(done + 1, len(others))
    return dict(sorted(poses.items()))


def _pose_between(backend: BackEnd, around: list[int], timestamp: float, image: Tensor) -> Tensor:
    """Return T_camera_world of a frame beside one keyframe or between two."""
    keyframes, grid = backend.keyframes, backend.grid
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
    backend.flow.add_frame(newest, image)
    matches = backend.flow.match(around, [newest] * count, predicted)
    backend.flow.remove_frame(newest)

    empty = torch.zeros(count + 1, len(grid.rays))
    problem = BundleProblem(
        camera=grid.camera,
        rays=grid.rays,
        edges_source=sources,
        edges_target=targets,
        targets=matches.targets,
        weights=matches.confidences * keyframes.trust[around, None],
        prior_disparities=empty,
        prior_weights=empty,
        free_poses=torch.arange(count + 1) == count,
        free_disparities=torch.zeros(count + 1, dtype=torch.bool),
        robust=backend.robust and backend.robust.widened(ROBUST_NARROWING),
    )
    if count == 1:
        # Nothing holds it from the other side, so it could follow a mover as a keyframe could.
        trust = keyframes.trust[around[0]]
        starts = [start, _continued(backend, around[0], timestamp)]
        poses[-1] = start_pose(
            grid, matches, disparities[0], trust, known[0], starts, backend.robust
        )
    state = BundleState(poses, torch.cat([disparities, empty[:1]]))
    state, _ = motion_only_adjust(problem, state, ITERATIONS)
    return state.T_camera_world[-1]


def _continued(backend: BackEnd, keyframe: int, timestamp: float) -> Tensor:
    """Return the pose (4, 4) to which the motion up to a keyframe would have led by now."""
    before, last = max(keyframe - 1, 0), keyframe
    poses, frames = backend.keyframes.T_camera_world, backend.keyframes.frames
    elapsed = frames[last].timestamp - frames[before].timestamp
    share = (timestamp - frames[before].timestamp) / elapsed if elapsed > 0 else 1.0
    return se3_interpolate(poses[before], poses[last], share)
