"""Keyframes that are adjusted again on what several views confirm to stand still."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.records import TrackedFrame, TrackingStatus
from minislam.stereo import second_adjustment
from minislam.stereo.second_adjustment import (
    COARSE_WIDTH,
    UNCONFIRMED_WEIGHT,
    adjust_again,
    adjust_confirmed,
)
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import final_global_ba
from tests.tracking.scene import CAMERA
from tests.tracking.wall import GRID, TrueFlow, true_graph, true_poses

HALF = CAMERA.width // 2
NUMBERS = [0, 3, 6, 9]


class FlowOfAProcession(TrueFlow):
    """True on the right; on the left, something moves slowly enough to look static."""

    def match(self, sources: list[int], targets: list[int], predicted: Tensor) -> FlowMatches:
        matches = super().match(sources, targets, predicted)
        steps = torch.tensor(
            [self.numbers[t] - self.numbers[s] for s, t in zip(sources, targets, strict=True)]
        )
        moved = 0.3 * steps[:, None] * (GRID.pixels[:, 0] < HALF)
        matches.targets[:, 0] += moved
        return matches


def linked_graph() -> KeyframeGraph:
    graph = true_graph(NUMBERS, flow=FlowOfAProcession())
    graph.match(neighbourhood_edges(0, len(NUMBERS), 5))
    return graph


def swept(graph: KeyframeGraph) -> list[tuple[Tensor, Tensor]]:
    """Return the true depth and confirmation of the right half, nothing of the left."""
    confirmed = (torch.arange(CAMERA.width) >= HALF).float().expand(CAMERA.height, -1)
    result = []
    for disparities in graph.keyframes.disparities:
        depth = (1 / disparities).reshape(GRID.shape)
        depth = depth.repeat_interleave(GRID.stride, 0).repeat_interleave(GRID.stride, 1)
        result.append((depth[: CAMERA.height, : CAMERA.width] * confirmed, confirmed))
    return result


def centre_error(graph: KeyframeGraph) -> float:
    """Return the largest error of a camera centre, relative to the length of the path."""
    estimate = se3_inverse(graph.keyframes.T_camera_world)[:, :3, 3]
    truth = se3_inverse(true_poses()[NUMBERS])[:, :3, 3]
    scale = (estimate * truth).sum() / estimate.square().sum()
    return float((scale * estimate - truth).norm(dim=1).max() / truth[-1].norm())


def test_what_is_not_confirmed_no_longer_bends_the_poses():
    graph = linked_graph()
    final_global_ba(graph)
    bent = centre_error(graph)
    graph = linked_graph()
    adjust_confirmed(graph, swept(graph))
    assert bent > 0.04 and centre_error(graph) < 0.005  # measured .056 and .0023


def test_confirmation_becomes_the_weight_and_swept_depth_the_start(monkeypatch):
    graph = linked_graph()
    graph.keyframes.static_weights[1] = torch.full_like(graph.keyframes.static_weights[1], 0.5)
    images = [(0.01 * depth, known) for depth, known in swept(graph)]  # all within one unit
    expected = graph.keyframes.disparities.clone()
    right = GRID.pixels[:, 0] >= HALF
    graph.keyframes.set_geometry(graph.keyframes.T_camera_world, 3 * expected)
    monkeypatch.setattr(second_adjustment, "final_global_ba", lambda graph, progress: None)
    assert adjust_confirmed(graph, images) == pytest.approx(float(right.float().mean()))
    weights, disparities = graph.keyframes.static_weights, graph.keyframes.disparities
    assert torch.allclose(disparities[:, right], 100 * expected[:, right])
    assert torch.equal(disparities[:, ~right], 3 * expected[:, ~right])  # the sweep found nothing
    assert (weights[0, right] == 1).all() and (weights[0, ~right] == UNCONFIRMED_WEIGHT).all()
    assert torch.equal(weights[1], weights[0] / 2)  # beta, or a given mask, goes on counting


def test_where_nothing_is_confirmed_all_cells_count_alike():
    first, second = linked_graph(), linked_graph()
    final_global_ba(first)
    nothing = [(torch.zeros_like(c), torch.zeros_like(c)) for _, c in swept(second)]
    assert adjust_confirmed(second, nothing) == 0
    poses = first.keyframes.T_camera_world
    assert torch.allclose(poses, second.keyframes.T_camera_world, atol=1e-3)


def test_frames_without_a_pose_before_the_adjustment_are_not_yet_lost(monkeypatch):
    graph, done = linked_graph(), []
    ok, count = TrackingStatus.OK, NUMBERS[-1] + 1
    followed = [TrackedFrame(index, float(index), ok, 1.0) for index in range(count)]
    lost = replace(followed[1], status=TrackingStatus.LOST)
    tracked = [followed[0], lost, *followed[2:]]
    watch = SimpleNamespace()
    tracker = SimpleNamespace(graph=graph, keyframes=graph.keyframes, tracked=tracked, watch=watch)
    tracker.conclude = lambda: done.append(("judged", graph.keyframes.static_weights.min()))

    def pose_frames(graph, tracked, sequence, progress):
        assert [frame.frame_index for frame in tracked] == NUMBERS
        return {0: torch.eye(4)}, NUMBERS[1:]

    def sweep(planner, frames, wanted, progress, workers):
        done.append((planner, frames, wanted))
        return swept(graph)

    monkeypatch.setattr(second_adjustment, "pose_frames", pose_frames)
    monkeypatch.setattr(second_adjustment, "dense_depths", sweep)
    told = SimpleNamespace(of=lambda graph, sequence, poses, width: (sorted(poses), width))
    monkeypatch.setattr(second_adjustment, "SweepPlanner", told)
    adjust_again(tracker, SimpleNamespace())
    assert tracker.tracked == [followed[0], lost, *followed[2:]]
    swept_first = ([0], COARSE_WIDTH), [0], NUMBERS
    assert done == [swept_first, ("judged", UNCONFIRMED_WEIGHT)]  # judged at the end
