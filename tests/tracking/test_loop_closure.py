"""Loops: which pairs close one, what an adjustment does with it, and when it is undone."""

from collections.abc import Iterable
from dataclasses import replace

import pytest
import torch

from minislam.geometry import se3_exp, se3_inverse, se3_log
from minislam.priors.interfaces import FlowMatches
from minislam.tracking import loop_closure
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.loop_closure import close_loops, loop_pairs
from tests.tracking.wall import TrueFlow, true_graph, true_poses

ROUND = [0, 1, 2, 3, 4, 3, 2, 1, 0]  # frames: there and back again
CONFIG = TrackingConfig(loop_min_gap=6, loop_distance=1e3, loop_edges=1, robust_scale=3.0)
# What has drifted on the way: the same slip from keyframe to keyframe.
SLIP = torch.tensor([0.006, -0.004, 0.003, 0.002, -0.002, 0.002], dtype=torch.float64)


class FlowThatNeverFits(TrueFlow):
    """Flow that is true between neighbours, and 40 px off between the ends of a loop."""

    def match(self, sources: list[int], targets: list[int], predicted: torch.Tensor) -> FlowMatches:
        matches = super().match(sources, targets, predicted)
        moved = matches.targets.clone()
        for edge, (source, target) in enumerate(zip(sources, targets, strict=True)):
            if abs(source - target) >= CONFIG.loop_min_gap:
                moved[edge] += 40.0 * torch.rand(moved[edge].shape, generator=seeded())
        return FlowMatches(moved, matches.confidences, matches.matched_ratios)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def drifted(flow: TrueFlow, frames: Iterable[int] = tuple(ROUND)) -> KeyframeGraph:
    graph = true_graph(list(frames), CONFIG, flow)
    count = len(graph.keyframes)
    graph.match(neighbourhood_edges(0, count, 1))
    poses = graph.keyframes.T_camera_world
    for index in range(1, count):
        poses[index] = se3_exp(index * SLIP) @ poses[index]
    return graph


def end_error(graph: KeyframeGraph) -> float:
    pose = graph.keyframes.T_camera_world[-1]
    return float(se3_log(pose @ se3_inverse(true_poses()[ROUND[-1]])).norm())


def test_a_loop_joins_places_far_apart_in_time_and_near_in_space():
    distances = torch.full((10, 10), 50.0)
    distances[9, 2] = distances[2, 9] = 5.0
    distances[9, 8] = distances[8, 9] = 1.0  # near, but only because no time has passed
    pairs = loop_pairs(distances, [], 9, 100.0, min_gap=5, limit=2)
    assert pairs[0] == (9, 2)
    assert all(newer - older >= 5 for newer, older in pairs)
    assert loop_pairs(distances, [], 9, 1.5, min_gap=5, limit=2) == []


def test_a_loop_that_is_closed_already_is_not_closed_again():
    distances = torch.full((10, 10), 5.0)
    taken = [(8, 2), (2, 8)]
    pairs = loop_pairs(distances, taken, 9, 100.0, min_gap=5, limit=9)
    assert (9, 2) not in pairs and (9, 3) not in pairs


def test_closing_a_loop_takes_the_drift_away():
    graph = drifted(TrueFlow())
    before = end_error(graph)
    assert close_loops(graph)
    assert (8, 0) in graph.edges.ends and (0, 8) in graph.edges.ends
    assert end_error(graph) < 0.2 * before


def test_a_loop_that_fits_already_is_linked_and_moves_nothing():
    graph = drifted(TrueFlow())
    graph.keyframes.set_geometry(
        torch.stack([true_poses()[n] for n in ROUND]), graph.state.disparities
    )
    before = graph.state
    assert not close_loops(graph)
    assert (8, 0) in graph.edges.ends
    assert torch.equal(graph.state.T_camera_world, before.T_camera_world)


def test_a_loop_that_does_not_fit_leaves_everything_as_it_was():
    graph = drifted(FlowThatNeverFits())
    state, edges = graph.state, list(graph.edges.ends)
    assert not close_loops(graph)
    assert torch.equal(graph.state.T_camera_world, state.T_camera_world)
    assert torch.equal(graph.state.disparities, state.disparities)
    assert graph.edges.ends == edges


def test_a_loop_whose_flow_is_not_confirmed_is_no_loop():
    shares = {(8, 0): 0.01, (8, 1): 0.01, (8, 2): 0.01}
    assert not close_loops(drifted(TrueFlow(shares)))


def test_a_short_sequence_has_no_loops():
    assert not close_loops(drifted(TrueFlow(), ROUND[:4]))


@pytest.mark.parametrize("ratio", [0.8, 1.2])
def test_how_near_a_loop_must_be_is_said_in_px_of_a_reference_image(ratio: float):
    graph = drifted(TrueFlow())
    nearest = float(graph.distances(rows=range(8, 9))[8, : 8 - CONFIG.loop_min_gap + 1].min())
    graph.config = replace(CONFIG, loop_distance=ratio * nearest / graph.pixel_scale)
    assert bool(loop_closure._loop_edges(graph)) == (ratio > 1)


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_how_well_a_loop_must_fit_is_said_in_px_of_a_reference_image(
    monkeypatch: pytest.MonkeyPatch, ratio: float
):
    graph = drifted(TrueFlow())
    limits = loop_closure.FITTING_RESIDUAL, loop_closure.MAX_LOOP_RESIDUAL
    told = iter([ratio * limit * graph.pixel_scale for limit in limits])
    monkeypatch.setattr(loop_closure, "mean_residual", lambda *_: next(told))
    assert not close_loops(graph)
    assert ((8, 0) in graph.edges.ends) == (ratio < 1)  # it fits already, or is undone
