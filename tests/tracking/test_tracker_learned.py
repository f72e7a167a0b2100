"""The tracker on a learned flow: an oracle in the network's place, at both schedules.

Only the ratios of learned confidences mean something, so their level decides nothing.
"""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from minislam.config import SlamConfig, preset
from minislam.tracking.tracker import Tracker
from tests.tracking import oracle

pytestmark = pytest.mark.slow

WARM_UP = 4  # keyframes, so that some follow
BLACK = range(20, 23)  # frames, after the warm-up
CASES = [
    ("laptop", "noise of half a pixel"),  # beside depth that is wrong by 7 %
    ("laptop", "one cell per update"),
    ("laptop", "15 % confident"),
    ("laptop", "8 % confident"),
    ("paper", "one cell per update"),
    ("paper", "8 % confident"),
]


@cache
def clip() -> oracle.Clip:
    return oracle.plain_clip("umbrella", seed=7, frames=40)


def tracked(name: str, skill: str, shown: oracle.Clip) -> Tracker:
    config: SlamConfig = preset(name)
    flow = oracle.OracleFlow(clip(), oracle.SKILLS[skill], config.networks.droid)
    return oracle.track(shown, flow, replace(config.tracking, warmup_keyframes=WARM_UP))


def lost(tracker: Tracker) -> list[int]:
    return [frame.frame_index for frame in tracker.tracked if not frame.status.is_followed]


@pytest.mark.parametrize(("schedule", "skill"), CASES)
def test_the_camera_is_followed_however_high_the_confidence_is(schedule: str, skill: str):
    tracker = tracked(schedule, skill, clip())
    of_keyframes, of_all = oracle.errors(clip(), tracker)  # cm
    assert not lost(tracker)
    assert 6 <= len(tracker.keyframes) <= 9
    assert of_keyframes < 0.15 and of_all < 0.3


def test_geometry_tells_which_frames_are_lost():
    rgb = clip().rgb.copy()
    rgb[BLACK] = np.float32(0)
    tracker = tracked("laptop", "confidence .08", replace(clip(), rgb=rgb))
    assert lost(tracker) == list(BLACK)
    of_keyframes, of_all = oracle.errors(clip(), tracker)
    assert of_keyframes < 0.15 and of_all < 0.3


def test_a_resumed_tracker_goes_on_in_the_same_way():
    config = preset("laptop")
    tracking = replace(config.tracking, warmup_keyframes=3)

    def new() -> Tracker:
        flow = oracle.OracleFlow(clip(), oracle.Skill(), config.networks.droid)
        return oracle.new_tracker(clip(), flow, tracking)

    first, second = new(), new()
    oracle.follow(first, clip(), range(18))
    second.restore_state(deepcopy(first.saved_state()), clip().frame)
    for tracker in (first, second):
        oracle.follow(tracker, clip(), range(18, 26))
    assert first.initialised and len(first.keyframes) == len(second.keyframes) > 3
    assert torch.equal(first.keyframes.T_camera_world, second.keyframes.T_camera_world)
    assert torch.equal(first.keyframes.disparities, second.keyframes.disparities)
