"""A frame is found again among keyframes of a recording, or not at all."""

from functools import cache

import pytest
import torch

from minislam.geometry import se3_inverse, se3_log
from minislam.tracking.safeguards.relocalisation import Relocaliser
from minislam.tracking.tracker import Tracker
from tests.tracking.recording import frames, new_tracker, recording, run

pytestmark = pytest.mark.slow


@cache
def finder() -> tuple[Relocaliser, Tracker]:
    """Return a relocaliser that knows the keyframes of the first twelve frames."""
    tracker = new_tracker(with_depth=True)
    run(tracker, frames()[:12])
    return Relocaliser(tracker.graph), tracker


def test_a_known_place_is_found():
    relocaliser, tracker = finder()
    frame = frames()[10]
    place = relocaliser.find(frame.image, tracker._features(frame))
    assert place is not None and place.inliers >= 20
    T_world_camera = torch.from_numpy(recording().T_world_camera)
    truth = se3_inverse(T_world_camera[10]) @ T_world_camera[0]
    assert float(se3_log(place.T_camera_world @ se3_inverse(truth)).norm()) < 0.02


def test_noise_is_no_known_place():
    relocaliser, tracker = finder()
    frame = frames()[10]
    noise = torch.rand(frame.image.shape, generator=torch.Generator().manual_seed(0))
    assert relocaliser.find(noise, tracker._features(frame)) is None


def test_an_image_without_keypoints_is_no_known_place():
    relocaliser, tracker = finder()
    frame = frames()[10]
    assert relocaliser.find(torch.zeros_like(frame.image), tracker._features(frame)) is None
