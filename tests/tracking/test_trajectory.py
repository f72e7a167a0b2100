"""Poses between the keyframes: the constant twist, and its correction on exact flow."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_interpolate, se3_inverse, se3_log
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame, TrackedFrame, TrackingStatus
from minislam.tracking.trajectory import pose_all_frames
from tests.helpers import random_transforms
from tests.tracking.wall import FRAMES, GRID, TrueFlow, true_graph, true_poses, wall_frame

KEYFRAMES = [0, 3, 5, 8]
LOST = 6


def posed(
    progress=None, flow: TrueFlow | None = None, frame=wall_frame, covered: int | None = None
) -> dict[int, Tensor]:
    """Return the poses of twelve frames, four of which are keyframes and one of which is lost.

    Of the keyframe `covered` beta trusts a twentieth of the cells only.
    """
    graph = true_graph(KEYFRAMES, flow=flow)
    if covered is not None:
        graph.keyframes.static_weights[covered, torch.arange(len(GRID.rays)) % 20 > 0] = 0.001
    tracked = [
        TrackedFrame(
            number, 0.1 * number, TrackingStatus.LOST if number == LOST else TrackingStatus.OK, 1.0
        )
        for number in range(FRAMES)
    ]
    tracker = SimpleNamespace(
        keyframes=graph.keyframes,
        graph=graph,
        tracked=tracked,
    )
    poses = pose_all_frames(tracker, SimpleNamespace(frame=frame), progress)
    assert set(graph.flow.numbers) == set(range(len(KEYFRAMES)))  # nothing left behind
    return poses


# Known answers


def test_half_way_of_a_shift_is_half_the_shift():
    first, second = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    second[:3, 3] = torch.tensor([2.0, -4.0, 6.0])
    half = se3_interpolate(first, second, 0.5)
    torch.testing.assert_close(half[:3, 3], torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))


def test_every_frame_that_was_not_lost_has_its_true_pose():
    poses, truth = posed(), true_poses()
    assert list(poses) == [number for number in range(FRAMES) if number != LOST]
    for number, pose in poses.items():
        error = se3_log(pose @ se3_inverse(truth[number])).norm()
        assert error < 1e-4, (number, float(error))


def test_a_view_that_a_dynamic_object_fills_is_not_lost():
    poses, truth = posed(covered=3), true_poses()
    assert set(poses) == {number for number in range(FRAMES) if number != LOST}
    assert se3_log(poses[10] @ se3_inverse(truth[10])).norm() < 1e-3  # from keyframe 3 alone


def test_it_is_the_flow_that_says_so():
    # Interpolation alone is off by more: the path is unsteady.
    truth = true_poses()
    guess = se3_interpolate(truth[5], truth[8], 2 / 3)
    assert se3_log(guess @ se3_inverse(truth[7])).norm() > 1e-2


class FlowWithFollower(TrueFlow):
    """True flow, but a quarter of the image goes along with the camera and stands still in it."""

    def match(self, sources: list[int], targets: list[int], predicted: Tensor) -> FlowMatches:
        matches = super().match(sources, targets, predicted)
        is_mover = GRID.pixels[:, 0] < GRID.stride * (GRID.shape[1] // 4)
        matches.targets[..., is_mover] = GRID.pixels[is_mover].T
        matches.confidences[..., is_mover] = 1.0
        return matches


def test_beyond_the_last_keyframe_nobody_takes_the_pose_along():
    poses, truth = posed(flow=FlowWithFollower()), true_poses()
    for number in range(KEYFRAMES[-1] + 1, FRAMES):
        error = se3_log(poses[number] @ se3_inverse(truth[number])).norm()
        assert error < 0.03, (number, float(error))  # 0.22 from the keyframe alone


def test_keyframes_keep_their_poses_to_the_bit():
    poses, truth = posed(), true_poses()
    assert all(torch.equal(poses[number], truth[number]) for number in KEYFRAMES)


def test_a_frame_that_repeats_the_one_before_it_has_its_pose_however_often():
    shown = {1: 0, 2: 0, 7: 5, 10: 9}  # 0 and 5 are keyframes; between 5 and 7 the camera was lost

    def frozen(number: int) -> Frame:
        like, noise = wall_frame(shown.get(number, number)), 0.0005 * (number % 2)
        return replace(like, frame_index=number, pixels=like.image + noise)

    poses = posed(frame=frozen)
    assert torch.equal(poses[1], poses[0]) and torch.equal(poses[2], poses[0])
    assert torch.equal(poses[10], poses[9]) and not torch.equal(poses[7], poses[5])


def test_progress_counts_the_frames_that_are_not_keyframes():
    calls = []
    posed(lambda done, of_all: calls.append((done, of_all)))
    count = FRAMES - len(KEYFRAMES) - 1
    assert calls == [(done, count) for done in range(1, count + 1)]


# Identities


@pytest.mark.parametrize("regime", ["normal", "tiny"])
def test_interpolation_ends_where_it_should_and_walks_evenly(regime: str):
    first, second = random_transforms(2, regime, 0)
    torch.testing.assert_close(se3_interpolate(first, second, 0.0), first)
    torch.testing.assert_close(se3_interpolate(first, second, 1.0), second)
    quarter = se3_interpolate(first, second, 0.25)
    half = se3_interpolate(first, second, 0.5)
    torch.testing.assert_close(se3_interpolate(first, half, 0.5), quarter)


def test_interpolation_does_not_depend_on_the_choice_of_the_world():
    first, second, other_world = random_transforms(3, "normal", 1)
    moved = se3_interpolate(first @ other_world, second @ other_world, 0.3)
    torch.testing.assert_close(moved, se3_interpolate(first, second, 0.3) @ other_world)


def test_a_constant_twist_is_followed_exactly():
    xi = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.4, -0.2], dtype=torch.float64)
    start = random_transforms(1, "normal", 2)[0]
    end = se3_exp(xi) @ start
    torch.testing.assert_close(se3_interpolate(start, end, 0.4), se3_exp(0.4 * xi) @ start)
