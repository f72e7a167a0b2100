"""Poses of the frames between the keyframes, and a trajectory of poses."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from minislam.errors import MinislamError
from minislam.geometry import se3_interpolate, se3_inverse
from minislam.records import Progress, Sequence, TrackedFrame, TrackingStatus, Trajectory
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards.pose_support import PoseFit, repeats, retry_doubtful
from minislam.tracking.tracker import Tracker


def pose_all_frames(
    tracker: Tracker, sequence: Sequence, progress: Progress | None = None
) -> dict[int, Tensor]:
    """Return T_camera_world (4, 4) of the frames by frame index; those without support are lost."""
    poses, lost = pose_frames(tracker.graph, tracker.tracked, sequence, progress)
    for position, tracked in enumerate(tracker.tracked):
        if tracked.frame_index in lost:
            tracker.tracked[position] = replace(tracked, status=TrackingStatus.LOST)
    return poses


def pose_frames(
    graph: KeyframeGraph,
    tracked: list[TrackedFrame],  # the followed ones of these are posed
    sequence: Sequence,
    progress: Progress | None = None,
) -> tuple[dict[int, Tensor], list[int]]:
    """Return T_camera_world (4, 4) of keyframes and frames by index, and frames without support.

    A keyframe keeps its pose; an image that repeats the one before takes its pose. Another frame
    starts from the interpolated pose and is adjusted on the flow from the keyframes around it; with
    little support it starts again from its neighbours, and has no pose if it stays without support.
    """
    frames, poses = graph.keyframes.frames, graph.keyframes.T_camera_world
    fits = {f.frame_index: PoseFit(T, 1.0) for f, T in zip(frames, poses, strict=True)}
    followed = [t for t in tracked if t.status.is_followed]
    others = {t.frame_index: t for t in followed if t.frame_index not in fits}
    shown = {frame.frame_index: frame for frame in frames}

    def fit_from(index: int, start: Tensor) -> PoseFit:
        frame = sequence.frame(index).to(poses.device)
        shown[index] = frame
        shown.pop(index - 2, None)
        before = shown.get(index - 1)
        if before is not None and index - 1 in fits and repeats(frame, before):
            return fits[index - 1]
        return PoseFit(*graph.fit_pose(frame, _around(graph, others[index]), start))

    for done, (index, other) in enumerate(others.items()):
        fits[index] = fit_from(index, _interpolate(graph, other))
        if progress:
            progress(done + 1, len(others))
    unsupported = retry_doubtful(fits, list(others), fit_from)
    return {index: fits[index].T_camera_world for index in sorted(fits)}, unsupported


def _around(graph: KeyframeGraph, tracked: TrackedFrame) -> list[int]:
    """Return the keyframes before and after a frame; before it only, if a loss or none follows."""
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


def as_trajectory(timestamps: list[float], T_camera_world: list[Tensor]) -> Trajectory:
    """Return poses (4, 4) and their timestamps [s], at least one, as a trajectory."""
    if not T_camera_world:
        raise MinislamError("expected at least one frame with a pose, found none")
    return Trajectory(np.array(timestamps), se3_inverse(torch.stack(T_camera_world)).cpu().numpy())
