"""Adjustments of the keyframe graph on exact flow: what enters a problem, and what moves."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse, se3_log
from minislam.tracking import frame_graph, optimisation
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.config import LearnedFlowConfig, TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import (
    adjust,
    bundle_problem,
    final_global_ba,
    local_ba,
    online_global_ba,
    typical_residual,
)
from minislam.tracking.safeguards import parts
from minislam.tracking.safeguards.parts import in_parts
from minislam.tracking.safeguards.robust import RobustKernel
from tests.tracking.scene import CAMERA, assert_same_bits
from tests.tracking.wall import TrueFlow, true_graph, true_poses

# As a network errs: a scale of its own in each of four keyframes.
WRONG = torch.tensor([[1.3], [0.8], [1.2], [0.7]])
XI = torch.tensor([0.03, -0.02, 0.02, 0.01, -0.01, 0.015], dtype=torch.float64)


def matched(count: int = 4, **settings: float) -> KeyframeGraph:
    """Return a graph at the truth whose neighbours are linked."""
    graph = true_graph(list(range(count)), TrackingConfig(**settings))
    graph.match(neighbourhood_edges(0, count, 2))
    return graph


def pose_error(graph: KeyframeGraph, keyframe: int) -> float:
    estimate = graph.keyframes.T_camera_world[keyframe]
    return float(se3_log(estimate @ se3_inverse(true_poses()[keyframe])).norm())


def move(graph: KeyframeGraph, keyframe: int) -> None:
    poses = graph.keyframes.T_camera_world
    poses[keyframe] = se3_exp(XI) @ poses[keyframe]


# What enters a problem


def test_only_edges_that_touch_a_free_keyframe_are_adjusted(monkeypatch):
    graph, asked = matched(5), []

    def noted(graph: KeyframeGraph, positions: list[int], *how: float):
        asked.append([graph.edges.ends[p] for p in positions])
        return bundle_problem(graph, positions, *how)

    monkeypatch.setattr(optimisation, "bundle_problem", noted)
    adjust(graph, 4, 1)
    adjust(graph, 0, 1)
    assert {*asked[0]} == {(4, 2), (2, 4), (4, 3), (3, 4)} and asked[1] == graph.edges.ends


def test_at_the_truth_all_residuals_are_zero():
    graph = matched()
    problem = bundle_problem(graph, range(len(graph.edges)))
    residual, valid = residuals(problem, graph.state)
    assert bool(valid.any()) and float((residual * problem.weights).abs().max()) < 1e-4


def test_weights_are_confidence_times_the_cell_weights_of_both_ends():
    graph = matched(2)
    graph.keyframes.static_weights[0] = 0.5
    graph.keyframes.static_weights[1] = 0.25
    problem = bundle_problem(graph, [0, 1])
    confidences = torch.stack(graph.edges.confidences)
    torch.testing.assert_close(problem.weights, 0.125 * confidences)


def test_weights_are_the_same_however_many_links_are_weighed_at_once(monkeypatch):
    graph = matched()
    graph.keyframes.static_weights[2] = torch.linspace(0, 1, len(graph.grid.rays))
    whole = bundle_problem(graph, range(len(graph.edges)))
    monkeypatch.setattr(frame_graph, "AT_ONCE", 3)
    split = bundle_problem(graph, range(len(graph.edges)))
    assert torch.equal(split.weights, whole.weights)


def test_the_typical_residual_is_that_of_the_cells_that_weigh():
    graph = matched(3)
    problem = bundle_problem(graph, range(len(graph.edges)))
    problem.targets[:, 0] += 0.3
    problem.targets[:, 1] += 0.4
    covered = graph.grid.pixels[:, 1] < CAMERA.height / 2 + 8
    problem.targets[..., covered] += 9.0
    problem.weights[..., covered] = 0
    assert typical_residual(problem, graph.state) == pytest.approx(0.5, abs=1e-3)
    problem.weights.zero_()
    assert typical_residual(problem, graph.state) is None


def test_the_typical_residual_of_links_in_parts_is_that_of_all(monkeypatch: pytest.MonkeyPatch):
    graph = matched()
    problem = bundle_problem(graph, range(len(graph.edges)))
    noise = torch.randn(problem.targets.shape, generator=torch.Generator().manual_seed(0))
    problem = replace(problem, targets=problem.targets + noise)
    whole = typical_residual(problem, graph.state)
    monkeypatch.setattr(parts, "CELLS_AT_ONCE", 1)
    assert len(list(in_parts(problem))) == 4
    assert typical_residual(problem, graph.state) == whole


def test_the_first_pose_never_moves_and_older_keyframes_stay():
    problem = bundle_problem(matched(), range(4))
    assert problem.free_poses.tolist() == [False, True, True, True]
    assert problem.free_disparities.tolist() == [True] * 4
    problem = bundle_problem(matched(), range(4), first_free=2)
    assert problem.free_poses.tolist() == [False, False, True, True]
    assert problem.free_disparities.tolist() == [False, False, True, True]


def test_the_prior_weighs_where_it_is_known_and_grows_with_the_focal_length():
    graph = matched()
    graph.keyframes.prior_disparities[1, 3] = 0.2
    weights = bundle_problem(graph, range(4), lambda_prior=0.01).prior_weights
    assert float(weights[1, 3]) == torch.tensor(0.01 * CAMERA.fx**2)
    assert int((weights > 0).sum()) == 1
    assert float(bundle_problem(graph, range(4)).prior_weights.sum()) == 0


# What moves


@pytest.mark.parametrize("has_prior", [True, False])
def test_without_parallax_a_start_keeps_the_disparities_that_a_prior_gave(has_prior: bool):
    graph = matched(3)
    graph.least_parallax = 1e3
    graph.keyframes.disparities *= 1.1
    graph.keyframes.prior_disparities[1, 4] = 0.2 * has_prior
    before = graph.keyframes.disparities.clone()
    adjust(graph, first_free=0, iterations=3)
    kept = (graph.keyframes.disparities == before).all(1)
    assert kept.tolist() == [False, has_prior, False]


def test_a_displaced_keyframe_finds_its_place():
    # The two keyframes before it are held: they fix the unit of length.
    graph = matched(rounds=1)
    move(graph, 3)
    assert pose_error(graph, 3) > 0.03
    adjust(graph, first_free=3, iterations=8)
    assert pose_error(graph, 3) < 1e-3
    assert max(pose_error(graph, keyframe) for keyframe in range(3)) < 1e-12
    assert graph.failed_adjustments == 0


def test_a_new_keyframe_is_linked_and_adjusted_without_knowing_where_it_is():
    graph = matched()
    everything = graph.edges.ends
    fresh = true_graph(list(range(4)))
    fresh.match([edge for edge in everything if 3 not in edge])
    move(fresh, 3)
    local_ba(fresh)
    assert {(0, 3), (1, 3), (2, 3), (3, 2)} <= set(fresh.edges.ends)
    first, last = fresh.keyframes.T_camera_world[0], fresh.keyframes.T_camera_world[3]
    assert torch.equal(first, true_poses()[0])
    # The unit of length may drift: it is the direction of the path that flow fixes.
    found, truth = (T[:3, 3] / T[:3, 3].norm() for T in (last, true_poses()[3]))
    assert float((found - truth).norm()) < 1e-2
    assert float((last[:3, :3] - true_poses()[3][:3, :3]).norm()) < 1e-3


@pytest.mark.parametrize("is_learned", [False, True])
def test_old_edges_fill_up_those_of_a_new_keyframe(monkeypatch, is_learned: bool):
    config = TrackingConfig(learned=LearnedFlowConfig(active_edges=24), active_edges=24)
    graph = true_graph(list(range(9)), config, TrueFlow(is_learned=is_learned))
    graph.match(neighbourhood_edges(0, 8, 5))
    old, asked = list(graph.edges.ends), []
    monkeypatch.setattr(graph, "match", asked.append)
    monkeypatch.setattr(optimisation, "adjust", lambda *_, **how: None)
    local_ba(graph)
    of_newest = [edge for edge in asked[0] if 8 in edge]
    assert asked[0] == of_newest + old[len(of_newest) - 24 :] and len({*asked[0]}) == 24


def test_a_wrong_prior_does_not_bend_a_new_keyframe_while_the_weight_is_wide():
    graphs = [true_graph(list(range(4)), TrackingConfig(rounds=0)) for _ in range(2)]
    graphs[1].keyframes.prior_disparities = graphs[1].keyframes.disparities * WRONG
    for graph in graphs:
        graph.match(neighbourhood_edges(0, 3, 2))
        local_ba(graph)
    plain, bent = (graph.keyframes.T_camera_world for graph in graphs)
    assert torch.equal(plain, bent)


def test_the_last_adjustment_keeps_the_truth():
    graph, calls = matched(), []
    final_global_ba(graph, lambda done, of_all: calls.append((done, of_all)))
    rounds = graph.config.final_rounds
    assert calls == [(done, rounds) for done in range(1, rounds + 1)] and (3, 0) in graph.edges.ends
    assert max(pose_error(graph, keyframe) for keyframe in range(4)) < 1e-3


def test_the_last_round_leaves_out_what_errs_more_than_flow_does(monkeypatch):
    def error(narrows: bool) -> float:
        graph, told = matched(), []
        covered = graph.grid.pixels[:, 0] < CAMERA.width / 10
        graph.edges.targets = [t + 0.6 * covered for t in graph.edges.targets]  # a slow mover
        monkeypatch.setattr(graph, "match", lambda edges: None)

        def narrowed(kernel: RobustKernel, residual: float) -> RobustKernel:
            told.append(residual)
            return replace(kernel, scale=0.2) if narrows else kernel

        monkeypatch.setattr(RobustKernel, "narrowed", narrowed)
        final_global_ba(graph)
        assert len(told) == 1 and 0.01 < told[0] < 0.3  # before, poses may have a bias
        return max(pose_error(graph, keyframe) for keyframe in range(4))

    assert 5 * error(narrows=True) < error(narrows=False)


def test_the_unit_of_length_is_chosen_without_changing_any_image():
    graph = matched()
    problem = bundle_problem(graph, range(len(graph.edges)))
    before, _ = residuals(problem, graph.state)
    graph.keyframes.normalise_scale()
    assert float(graph.keyframes.disparities.median()) == 1.0
    after, _ = residuals(problem, graph.state)
    torch.testing.assert_close(after, before, atol=1e-4, rtol=0)


# What fails


def test_adjustments_that_all_fail_are_counted_and_keep_the_state(monkeypatch: pytest.MonkeyPatch):
    graph = matched()
    move(graph, 3)
    before = BundleState(graph.state.T_camera_world.clone(), graph.state.disparities.clone())

    def singular(S: Tensor) -> tuple[Tensor, bool]:
        return S, True

    monkeypatch.setattr(torch.linalg, "cholesky_ex", singular)
    adjust(graph, first_free=2, iterations=3)
    final_global_ba(graph)
    assert graph.adjustments == graph.failed_adjustments == 1 + graph.config.final_rounds
    assert_same_bits(graph.state, before)


# Online


def drifted(keyframe: int) -> KeyframeGraph:
    """Return the graph of twelve keyframes, those from one on off by the same motion."""
    graph = matched(12)
    for later in range(keyframe, 12):
        move(graph, later)
    return graph


def test_all_keyframes_are_adjusted_only_if_a_sample_of_new_edges_does_not_fit(monkeypatch):
    graph = matched(12)
    every, sampled = len(graph.global_edges()), len(graph.global_edges(optimisation.SAMPLED))
    assert every > 3 * sampled > 0
    monkeypatch.setattr(optimisation, "ENOUGH_EDGES", sampled)
    known, poses = len(graph.edges), graph.keyframes.T_camera_world.clone()
    online_global_ba(graph)
    assert len(graph.edges) == known + sampled
    assert torch.equal(graph.keyframes.T_camera_world, poses)

    graph = drifted(8)
    assert pose_error(graph, 11) > 0.02
    expected = known + len(graph.global_edges())
    online_global_ba(graph)
    assert len(graph.edges) == expected and pose_error(graph, 11) < 5e-3


def test_a_sample_of_few_edges_does_not_tell_whether_all_fit(monkeypatch):
    graph = matched(12)
    expected = len(graph.edges) + len(graph.global_edges())
    enough = len(graph.global_edges(optimisation.SAMPLED)) + 1
    monkeypatch.setattr(optimisation, "ENOUGH_EDGES", enough)
    online_global_ba(graph)
    assert len(graph.edges) == expected


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_how_well_new_edges_must_fit_is_said_in_px_of_a_reference_image(monkeypatch, ratio: float):
    graph, adjusted = matched(12), []
    told = ratio * optimisation.FITTING_RESIDUAL * graph.pixel_scale
    monkeypatch.setattr(optimisation, "mean_residual", lambda *_: told)
    monkeypatch.setattr(optimisation, "ENOUGH_EDGES", 1)
    monkeypatch.setattr(optimisation, "adjust", lambda *_, **__: adjusted.append(None))
    online_global_ba(graph)
    assert bool(adjusted) == (ratio > 1)
