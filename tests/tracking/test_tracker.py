"""The tracker from the first frame to the last adjustment, on a small synthetic sequence."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from minislam.errors import MinislamError
from minislam.evaluation.trajectory import Alignment, absolute_trajectory_error
from minislam.records import Frame, TrackingStatus, Trajectory
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.tracker import LONGEST_TAIL, Mode, Tracker
from tests.tracking.recording import (
    CONFIG,
    SIZE,
    WHERE_LOST,
    frames,
    lost_frames,
    new_tracker,
    recording,
    run,
    trajectories,
)

pytestmark = pytest.mark.slow


@cache
def finished(with_depth: bool) -> Tracker:
    tracker = new_tracker(with_depth)
    run(tracker, frames())
    return tracker


def path_length(trajectory: Trajectory) -> float:
    return float(np.linalg.norm(np.diff(trajectory.centres, axis=0), axis=1).sum())


@pytest.mark.parametrize("with_depth", [True, False])
def test_the_camera_is_followed(with_depth: bool):
    tracker = finished(with_depth)
    estimate, truth = trajectories(tracker)
    assert len(estimate) >= 4
    statuses = [frame.status for frame in tracker.tracked]
    start = statuses.index(TrackingStatus.OK)
    assert set(statuses[:start]) == {TrackingStatus.INITIALISING}
    assert set(statuses[start:]) == {TrackingStatus.OK}
    error = absolute_trajectory_error(estimate, truth, Alignment.SIM3)
    assert error.statistics["rmse"] < 5e-3 * path_length(truth)


def test_true_depth_gives_the_scale():
    estimate, truth = trajectories(finished(with_depth=True))
    error = absolute_trajectory_error(estimate, truth, Alignment.SIM3)
    # The last adjustment is without the prior, as in the paper, and lets the scale drift a little.
    assert error.similarity.scale == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("with_depth", [True, False])
def test_disparities_are_those_of_the_scene_up_to_scale(with_depth: bool):
    tracker = finished(with_depth)
    chosen = [frame.frame_index for frame in tracker.keyframes.frames]
    truth = 1 / recording().depth[chosen][:, ::8, ::8].reshape(len(chosen), -1)
    ratio = tracker.keyframes.disparities.numpy() / truth
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.02


def test_the_first_pose_is_the_world():
    identity = torch.eye(4, dtype=torch.float64)
    assert torch.equal(finished(with_depth=True).keyframes.T_camera_world[0], identity)


def test_no_adjustment_failed():
    graph = finished(with_depth=True).graph
    assert graph.adjustments > 0 == graph.failed_adjustments


def test_the_modes_follow_each_other():
    tracker, images = new_tracker(with_depth=True), frames()
    assert tracker.mode is Mode.WAITING and not tracker.initialised
    assert tracker.track(images[0]) and tracker.mode is Mode.WARMING_UP
    assert not tracker.track(images[1]) and len(tracker.keyframes) == 1
    tracker.initialise()
    assert tracker.mode is Mode.TRACKING and len(tracker.keyframes) == 2
    tracker.track(Frame(2, 2 / 30, torch.zeros_like(images[0].image)))
    assert tracker.mode is Mode.LOST and tracker.initialised
    tracker.track(images[3])
    assert tracker.mode is Mode.TRACKING


def test_the_last_frame_becomes_a_keyframe():
    tracker = new_tracker(with_depth=True)
    run(tracker, frames()[:14])
    followed = [t.frame_index for t in tracker.tracked if t.status.is_followed]
    tracker.end()
    assert followed[-1] - tracker.keyframes.frames[-1].frame_index <= LONGEST_TAIL
    count = len(tracker.keyframes)
    tracker.end()
    assert len(tracker.keyframes) == count


def test_two_runs_are_the_same_to_the_bit():
    first, second = finished(with_depth=True), new_tracker(with_depth=True)
    run(second, frames())
    assert torch.equal(first.keyframes.T_camera_world, second.keyframes.T_camera_world)
    assert torch.equal(first.keyframes.disparities, second.keyframes.disparities)


@pytest.mark.parametrize("kind", ["noise", "black"])
def test_a_spoilt_frame_is_lost_and_the_next_is_found_again(kind: str):
    images = frames()[: WHERE_LOST + 6]
    source = torch.Generator().manual_seed(0)
    noise = torch.rand(images[0].image.shape, generator=source)
    spoilt = noise if kind == "noise" else torch.zeros_like(noise)
    images[WHERE_LOST] = Frame(WHERE_LOST, images[WHERE_LOST].timestamp, spoilt)
    tracker = new_tracker(with_depth=True)
    run(tracker, images)
    assert lost_frames(tracker) == [WHERE_LOST]
    estimate, truth = trajectories(tracker)
    error = absolute_trajectory_error(estimate, truth, Alignment.SIM3)
    assert error.statistics["rmse"] < 5e-3 * path_length(truth)


def global_adjustments(monkeypatch, keyframes: int, interval: int, loops: Sequence[int] = ()):
    """Return at how many keyframes all of them are adjusted; `loops` are where one is closed."""
    tracker, adjusted = new_tracker(with_depth=False), []
    tracker.config = replace(CONFIG, global_interval=interval)
    monkeypatch.setattr(
        "minislam.tracking.tracker.online_global_ba",
        lambda graph: adjusted.append(len(graph.keyframes)),
    )
    monkeypatch.setattr(
        "minislam.tracking.tracker.close_loops", lambda graph, _: len(graph.keyframes) in loops
    )
    for _ in range(keyframes):
        tracker.keyframes.frames.append(frames()[0])
        tracker._adjust_all_if_due()
    return adjusted


def test_all_keyframes_are_adjusted_online_after_an_interval_and_then_once_half_are_new(
    monkeypatch,
):
    assert global_adjustments(monkeypatch, 200, interval=20) == [20, 40, 80, 160]
    assert global_adjustments(monkeypatch, 200, interval=0) == []
    assert global_adjustments(monkeypatch, 1000, interval=150) == [150, 300, 600]


def test_a_closed_loop_counts_as_an_adjustment_of_all(monkeypatch):
    found = global_adjustments(monkeypatch, 160, interval=20, loops=[15, 35, 120])
    assert found == [70]


def test_an_untold_focal_length_is_sought_before_all_are_adjusted_until_it_is_free(monkeypatch):
    sought = []

    def told_by_forty(graph: KeyframeGraph) -> None:
        sought.append(len(graph.keyframes))
        graph.focal_is_free = len(graph.keyframes) == 40

    monkeypatch.setattr("minislam.tracking.tracker.seek_focal_length", told_by_forty)
    assert global_adjustments(monkeypatch, 200, interval=20) == [20, 40, 80, 160]
    assert sought == [20, 40]


def test_blank_images_are_an_error_of_one_sentence():
    tracker = new_tracker(with_depth=False)
    blank = torch.full((SIZE[1], SIZE[0], 3), 0.5)
    with pytest.raises(MinislamError, match="found none among 3 frames"):
        run(tracker, [Frame(index, 0.1 * index, blank) for index in range(3)])
    assert lost_frames(tracker) == [0, 1]  # each time the next one may be the first
