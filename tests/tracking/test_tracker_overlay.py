"""A bonnet covers the same fifth of every image: the camera is followed by the rest."""

import numpy as np
import pytest
import torch

from data_synth import SyntheticSequence, generate
from minislam.evaluation import absolute_trajectory_error
from minislam.geometry import Camera, se3_inverse
from minislam.priors.depth import NoDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame, Trajectory
from minislam.tracking.config import TrackingConfig
from minislam.tracking.safeguards.first_frame import has_warmed_up
from minislam.tracking.tracker import Tracker

pytestmark = pytest.mark.slow

SIZE, SHOWN = (160, 120), range(0, 60, 3)


@pytest.fixture(scope="module")
def clip() -> SyntheticSequence:
    return generate("static", seed=1, frames=SHOWN.stop, size=SIZE)


@pytest.fixture(scope="module")
def tracker(clip: SyntheticSequence) -> Tracker:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    bonnet = (((u - 80) / 95) ** 2 + ((v - 125) / 30) ** 2 < 1)[..., None]
    spots = np.random.default_rng(0).random((24, 32, 1), np.float32).repeat(5, 0).repeat(5, 1)
    k = clip.intrinsics
    parts = ClassicalFlow(), ClassicalFeatures(), NoDepth(), lambda _: torch.ones(15, 20)
    config = TrackingConfig(warmup_keyframes=4)  # so that some keyframes come after the start
    tracker = Tracker(Camera(k.fx, k.fy, k.cx, k.cy, *SIZE), config, *parts)
    for number, index in enumerate(SHOWN):
        image = torch.from_numpy(np.where(bonnet, spots, clip.rgb[index]))
        tracker.track(Frame(number, clip.timestamps[index], image))
        if not tracker.initialised and has_warmed_up(tracker):
            tracker.initialise()
            tracker.refine_initialisation()
    tracker.finish()
    return tracker


def test_the_bonnet_is_found(tracker: Tracker):
    overlay = tracker.keyframes.overlay
    assert overlay is not None
    assert 0.15 < float((overlay == 0).float().mean()) < 0.35
    assert (overlay.reshape(15, 20)[:8] == 1).all()


def test_no_flow_of_it_counts(tracker: Tracker):
    covered = tracker.keyframes.overlay == 0
    chained = [tracker.last_non_keyframe[1]] if tracker.last_non_keyframe else []
    for matches in [*tracker.graph.flow_to_next, *chained]:
        assert (matches.confidences[..., covered] == 0).all()
        assert matches.confidences[..., ~covered].max() > 0.5


def test_the_camera_is_followed(tracker: Tracker, clip: SyntheticSequence):
    assert all(tracked.status.is_followed for tracked in tracker.tracked)
    shown = [SHOWN[frame.frame_index] for frame in tracker.keyframes.frames]
    truth = Trajectory(clip.timestamps[shown], clip.T_world_camera[shown])
    found = se3_inverse(tracker.keyframes.T_camera_world).numpy()
    error = absolute_trajectory_error(Trajectory(clip.timestamps[shown], found), truth)
    assert error.statistics["rmse"] < 0.008  # measured .0027 m
