"""Without a depth prior, the camera must not follow a table that is carried through its view."""

import pytest
import torch

from data_synth import generate
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

FRAMES, SIZE = 60, (160, 120)


def ate_of_keyframes(config: TrackingConfig) -> float:
    """Track table2, whose table fills half of the view from the middle on; return the ATE [m]."""
    clip = generate("table2", seed=5, frames=FRAMES, size=SIZE)
    k = clip.intrinsics
    parts = config, ClassicalFlow(), ClassicalFeatures(), NoDepth(), lambda _: torch.ones(15, 20)
    tracker = Tracker(Camera(k.fx, k.fy, k.cx, k.cy, *SIZE), *parts)
    for index in range(FRAMES):
        tracker.track(Frame(index, clip.timestamps[index], torch.from_numpy(clip.rgb[index])))
        if not tracker.initialised and has_warmed_up(tracker):
            tracker.initialise()
            tracker.refine_initialisation()
    tracker.finish()
    shown = [frame.frame_index for frame in tracker.keyframes.frames]
    times, truth = clip.timestamps[shown], clip.T_world_camera[shown]
    estimate = Trajectory(times, se3_inverse(tracker.keyframes.T_camera_world).numpy())
    return absolute_trajectory_error(estimate, Trajectory(times, truth)).statistics["rmse"]


def test_the_memory_holds_the_camera():
    assert ate_of_keyframes(TrackingConfig()) < 0.005  # measured .0020 m


def test_without_it_the_camera_follows_the_table():
    assert ate_of_keyframes(TrackingConfig(motion_memory=0.0)) > 0.05  # measured .12 m
