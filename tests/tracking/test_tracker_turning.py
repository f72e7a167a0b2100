"""A camera that only turns, and one that jumps ahead by a second: both are followed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from data_synth import default_intrinsics, render_frame, scene
from data_synth.sequence import SyntheticFrame
from minislam.geometry import Camera, se3_inverse
from minislam.priors.depth import NoDepth, SensorDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame
from minislam.tracking.tracker import Tracker
from tests.tracking.recording import CONFIG, SIZE, lost_frames, run

pytestmark = pytest.mark.slow

TURNED = 20  # frames of a turn
TURN = 0.3  # rad, the most that the camera turns to the side
MAX_TURN_ERROR = 0.3  # degrees
MAX_DRIFT = 0.02  # of the distance to what is seen
BEFORE, MISSED = 16, 30  # frames until the jump, and frames that are missing then
PLACE_ERROR = 0.02  # of the distance between the first and the farthest camera


@cache
def turning() -> list[SyntheticFrame]:
    """Return what a camera sees that turns aside and back where it stands."""
    view = scene("static", seed=1)
    T_start = view.path(0.0)

    def path(time: float) -> np.ndarray:  # (4, 4)
        angle = TURN * np.sin(np.pi * 30 * time / TURNED)
        turn = Rotation.from_rotvec([0.3 * angle, angle, 0.1 * angle]).as_matrix()
        T_world_camera = T_start.copy()
        T_world_camera[:3, :3] = T_start[:3, :3] @ turn
        return T_world_camera

    view = replace(view, path=path)
    return [render_frame(view, default_intrinsics(SIZE), index) for index in range(TURNED)]


def followed(recorded: list[SyntheticFrame], with_depth: bool) -> Tracker:
    """Return a tracker that has seen these frames as one sequence."""
    k = default_intrinsics(SIZE)
    depth = SensorDepth(lambda index: recorded[index].depth) if with_depth else NoDepth()
    tracker = Tracker(
        Camera(k.fx, k.fy, k.cx, k.cy, *SIZE),
        CONFIG,
        ClassicalFlow(),
        ClassicalFeatures(),
        depth,
        lambda keyframe_index: torch.ones(15, 20),
    )
    images = [torch.from_numpy(frame.rgb).float() / 255 for frame in recorded]
    run(tracker, [Frame(index, index / 30, image) for index, image in enumerate(images)])
    return tracker


def poses(tracker: Tracker, recorded: list[SyntheticFrame]) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimated and the true T_first_camera (K, 4, 4) of the keyframes."""
    truth = [recorded[frame.frame_index].T_world_camera for frame in tracker.keyframes.frames]
    T_first_world = np.linalg.inv(truth[0])
    estimate = se3_inverse(tracker.keyframes.T_camera_world).numpy()
    return estimate, np.array([T_first_world @ T for T in truth])


@pytest.mark.parametrize("with_depth", [True, False])
def test_a_camera_that_only_turns_is_followed_and_known_to_stand(with_depth: bool):
    tracker = followed(turning(), with_depth)
    assert lost_frames(tracker) == []
    estimate, truth = poses(tracker, turning())
    difference = Rotation.from_matrix(estimate[:, :3, :3].swapaxes(1, 2) @ truth[:, :3, :3])
    assert np.degrees(difference.magnitude()).max() < MAX_TURN_ERROR
    if with_depth:  # without it there is no unit to measure a drift in
        distance = np.median(turning()[0].depth)
        assert np.linalg.norm(estimate[:, :3, 3], axis=1).max() < MAX_DRIFT * distance
    # That is what the run warns of: the distances that the camera covered are unknown.
    least = tracker.graph.least_parallax
    assert len(tracker.watch.diagnostics) == len(tracker.keyframes) > 4
    assert all(found.parallax < least for found in tracker.watch.diagnostics)


@cache
def jumping() -> list[SyntheticFrame]:
    """Return a walk that misses a second and then comes back the same way, faster."""
    view, intrinsics = scene("static", seed=1), default_intrinsics(SIZE)
    shown = [*range(BEFORE), *range(BEFORE + MISSED, BEFORE - 6, -3)]
    return [render_frame(view, intrinsics, index) for index in shown]


def largest_error(tracker: Tracker, recorded: list[SyntheticFrame]) -> float:
    """Return the largest error of a keyframe's place, relative to the extent of the path."""
    estimate, truth = (T[:, :3, 3] for T in poses(tracker, recorded))
    estimate = estimate * (estimate * truth).sum() / (estimate**2).sum()
    return np.abs(estimate - truth).max() / np.linalg.norm(truth, axis=1).max()


def test_a_jump_ahead_to_a_view_that_overlaps_is_bridged():
    tracker = followed(jumping(), with_depth=False)  # a jump back: with depth, test_tracker_losing
    assert lost_frames(tracker) == []
    assert largest_error(tracker, jumping()) < PLACE_ERROR
