"""A camera that sees nothing, jumps, stands still or only turns: each has a defined outcome."""

import numpy as np
import pytest
import torch

from minislam.geometry import se3_inverse
from minislam.records import Frame, TrackingStatus
from minislam.tracking.trajectory import pose_all_frames
from tests.tracking.recording import (
    CONFIG,
    FRAMES,
    frames,
    lost_frames,
    new_tracker,
    recording,
    run,
)

pytestmark = pytest.mark.slow

BLIND = 20  # first frame without a view
PLACE_ERROR = 0.02  # of the distance between the first and the last camera


def renumbered(images: list[torch.Tensor]) -> list[Frame]:
    return [Frame(index, index / 30, image) for index, image in enumerate(images)]


def centres(tracker, shown: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and true camera centres of the keyframes, the estimate scaled to fit."""
    which = [frame.frame_index for frame in tracker.keyframes.frames]
    estimate = se3_inverse(tracker.keyframes.T_camera_world)[:, :3, 3].numpy()
    T_world_camera = recording().T_world_camera
    T_first = np.linalg.inv(T_world_camera[shown[which[0]]])
    truth = np.array([(T_first @ T_world_camera[shown[w]])[:3, 3] for w in which])
    scale = (estimate * truth).sum() / (estimate**2).sum()
    return scale * estimate, truth


def test_ten_black_frames_are_lost_and_the_camera_is_found_again():
    images = [frame.image for frame in frames()]
    black = [torch.zeros_like(images[0])] * 10
    # It comes back to a place it left a while ago, not to where it was lost.
    shown = [*range(BLIND), *[0] * 10, *range(8, 14)]
    tracker = new_tracker(with_depth=True, shown=shown)
    run(tracker, renumbered(images[:BLIND] + black + images[8:14]))
    assert lost_frames(tracker) == list(range(BLIND, BLIND + 10))
    statuses = {tracker.tracked[index].status for index in lost_frames(tracker)}
    assert statuses == {TrackingStatus.LOST}
    estimate, truth = centres(tracker, shown)
    assert np.abs(estimate - truth).max() < PLACE_ERROR * np.linalg.norm(truth, axis=1).max()


def test_a_long_blindness_is_lost_and_the_frames_after_it_have_poses():
    images = [frame.image for frame in frames()]
    blind = 20
    black = [torch.zeros_like(images[0])] * blind
    sequence = renumbered(images[:BLIND] + black + images[4:8])
    tracker = new_tracker(with_depth=True, shown=[*range(BLIND), *[0] * blind, *range(4, 8)])
    run(tracker, sequence)
    statuses = [frame.status for frame in tracker.tracked]
    assert statuses[BLIND : BLIND + blind] == [TrackingStatus.LOST] * blind
    assert statuses[-4:] == [TrackingStatus.OK] * 4
    poses = pose_all_frames(tracker, FrameList(sequence))
    assert sorted(poses) == [*range(BLIND), *range(BLIND + blind, BLIND + blind + 4)]


class FrameList:
    """Just what posing all frames asks of a sequence."""

    def __init__(self, images: list[Frame]) -> None:
        self._images = images

    def frame(self, frame_index: int) -> Frame:
        return self._images[frame_index]


def test_an_unknown_place_stays_lost():
    images = [frame.image for frame in frames()]
    source = torch.Generator().manual_seed(0)
    elsewhere = [torch.rand(images[0].shape, generator=source) for _ in range(4)]
    tracker = new_tracker(with_depth=True)
    run(tracker, renumbered(images[:BLIND] + elsewhere))
    assert lost_frames(tracker) == list(range(BLIND, BLIND + 4))
    assert len(tracker.keyframes.frames) == len(tracker.keyframes.T_camera_world)


def test_a_jump_back_is_bridged():
    shown = [*range(FRAMES), *range(2, 8)]
    images = [frame.image for frame in frames()]
    tracker = new_tracker(with_depth=True, shown=shown)
    run(tracker, renumbered([images[index] for index in shown]))
    assert lost_frames(tracker) == []
    estimate, truth = centres(tracker, shown)
    assert np.abs(estimate - truth).max() < 2 * PLACE_ERROR * np.linalg.norm(truth, axis=1).max()


def test_a_standing_camera_makes_few_keyframes_and_does_not_move():
    image = frames()[0].image
    tracker = new_tracker(with_depth=True, shown=[0] * FRAMES)
    run(tracker, renumbered([image] * FRAMES))
    assert lost_frames(tracker) == []
    assert len(tracker.keyframes) <= FRAMES // CONFIG.keyframe_interval + 1
    identity = torch.eye(4, dtype=torch.float64)
    assert (tracker.keyframes.T_camera_world - identity).abs().max() < 1e-3
