"""Flow that no turn explains, and turns without depth."""

import math

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse, se3_log
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards import diagnostics
from minislam.tracking.safeguards.diagnostics import (
    LEAST_BEYOND_TURNS,
    LEAST_CONFIRMED,
    MAX_DEPTH_ERROR,
    MOST_RESTING,
    Watch,
    diagnose,
)
from minislam.tracking.safeguards.turns import adjust_turns, flow_beyond_turns, fraction_at_rest
from tests.tracking.scene import assert_same_bits
from tests.tracking.wall import CAMERA, GRID, true_graph

TURNS = [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01), (0.03, 0.05, -0.02)]  # rad


def seen_moving(positions: Tensor) -> KeyframeGraph:
    """Return two keyframes between which the cells move to positions (N, 2)."""
    graph = true_graph([0, 1])
    graph.match([(0, 1), (1, 0)])
    graph.edges.targets[0] = positions.T.float()
    graph.edges.confidences[0] = torch.ones_like(graph.edges.targets[0])
    return graph


def watched(positions: Tensor) -> tuple[KeyframeGraph, Watch]:
    """Return two keyframes between which the cells move to positions (N, 2), judged."""
    graph = seen_moving(positions)
    watch = Watch(graph)
    watch.conclude()
    return graph, watch


def test_a_turn_is_no_parallax_whatever_the_poses_claim():
    turn = se3_exp(torch.tensor([0, 0, 0, 0.03, 0.05, 0.1], dtype=torch.float64))
    graph = seen_moving(CAMERA.project(GRID.rays.double() @ turn[:3, :3].T))
    assert flow_beyond_turns(graph) < 1e-3 < 3 < diagnose(graph, 1).parallax


def test_under_a_wrong_focal_length_a_turn_is_no_parallax_either():
    turn = se3_exp(torch.tensor([0, 0, 0, 0.1, 0.15, 0.3], dtype=torch.float64))
    graph = seen_moving(CAMERA.project(GRID.rays.double() @ turn[:3, :3].T))
    graph.grid.zoom(math.log(1.5))
    assert flow_beyond_turns(graph) > 1  # px: the focal length is given
    graph.seeks_focal = True
    assert flow_beyond_turns(graph) < 0.01
    graph.focal_is_free = True  # the motion has told it
    assert flow_beyond_turns(graph) > 1


def test_a_turn_whose_poses_claim_parallax_may_show_a_flat_scene():
    turn = se3_exp(torch.tensor([0, 0, 0, 0.03, 0.05, 0.1], dtype=torch.float64))
    graph, watch = watched(CAMERA.project(GRID.rays.double() @ turn[:3, :3].T))
    assert watch.diagnostics[1].parallax > 3 and watch.resting == 0 and not watch.only_turned
    near = GRID.pixels[:, 1] > 0.7 * CAMERA.height
    graph.keyframes.disparities[:, ~near] *= 0.01  # the nearest cells alone tell parallax
    watch.conclude()
    assert watch.diagnostics[1].parallax > graph.least_parallax
    assert watch.resting == 1 and watch.only_turned
    assert watch.hardly_walked
    watch.beyond_turns = LEAST_BEYOND_TURNS
    assert watch.only_turned and not watch.hardly_walked  # first and last frame of a film
    watch.diagnostics.append(watch.diagnostics[1])
    assert not watch.only_turned


def test_a_keyframe_rests_unless_some_link_that_sees_its_cells_shows_parallax():
    graph = true_graph([0, 0, 2, 2])
    assert fraction_at_rest(graph) == 1  # without edges
    graph.match([(0, 1), (1, 0), (2, 3), (3, 2)])
    assert fraction_at_rest(graph) == 1
    graph.match([(1, 2)])
    assert fraction_at_rest(graph) == 0.75
    graph.keyframes.T_camera_world[2, 0, 3] += 50.0  # there no cell of the others is seen
    assert fraction_at_rest(graph) == 1


def test_parallax_that_no_sweep_confirms_is_none():
    graph, watch = watched(GRID.pixels + GRID.pixels.new_tensor([0.5, 0.0]))
    graph.least_parallax = 0.0  # the poses claim parallax, of which hardly any flow is left
    assert not watch.only_turned
    watch.confirmed = 0.5 * LEAST_CONFIRMED
    assert watch.only_turned
    watch = Watch(true_graph([0, 1, 2]))  # without edges no pose claims parallax
    watch.conclude()
    assert watch.beyond_turns is None and watch.only_turned and not watch.hardly_walked


@pytest.mark.parametrize(("difference", "breaks"), [(0.3, 0), (0.1, 1), (None, 1)])
def test_depths_that_the_flow_hardly_measures_break_no_trajectory(
    monkeypatch: pytest.MonkeyPatch, difference: float | None, breaks: int
):
    graph, watch = watched(GRID.pixels + GRID.pixels.new_tensor([0.5, 0.0]))
    graph.least_parallax = 0.0
    graph.keyframes.disparities[1] *= 2
    monkeypatch.setattr(diagnostics, "depth_difference", lambda graph: difference)
    watch.conclude()
    assert watch.hardly_walked and not watch.only_turned
    assert watch.diagnostics[1].depth_error > MAX_DEPTH_ERROR and len(watch.breaks) == breaks
    graph.keyframes.prior_disparities[:] = 1.0  # a prior measures them
    watch.conclude()
    assert len(watch.breaks) == 1 and not watch.has_two_depths


def test_weak_parallax_is_depth_only_if_poses_and_sweeps_make_depth_of_it():
    _, watch = watched(GRID.pixels + GRID.pixels.new_tensor([20.0, 0.0]))
    assert watch.diagnostics[1].parallax > 3  # by its poses
    watch.diagnostics.append(watch.diagnostics[1])
    weak, few, many = 0.5 * LEAST_BEYOND_TURNS, 0.9 * MOST_RESTING, 1.1 * MOST_RESTING
    cases = [(weak, few, 2.0, False), (weak, many, 2.0, True), (weak, few, 0.5, True)]
    cases += [(strong, many, 0.0, False) for strong in (LEAST_BEYOND_TURNS, None)]
    for watch.beyond_turns, watch.resting, confirmed, expected in cases:
        watch.confirmed = confirmed * LEAST_CONFIRMED
        assert watch.only_turned == expected


@pytest.mark.parametrize("moving", [0.1, 0.2])
def test_what_moves_in_front_of_a_turning_camera_is_no_sign_of_depth(moving: float):
    turn = se3_exp(torch.tensor([0, 0, 0, 0.03, 0.05, 0.1], dtype=torch.float64))
    positions = CAMERA.project(GRID.rays.double() @ turn[:3, :3].T)
    positions[GRID.pixels[:, 0] < moving * CAMERA.width] += 20  # px
    assert flow_beyond_turns(seen_moving(positions)) < 0.3  # 15 and 28 by least squares


def test_walking_ahead_is_more_than_any_turn():
    from_centre = GRID.pixels - GRID.pixels.new_tensor([CAMERA.cx, CAMERA.cy])
    graph = seen_moving(GRID.pixels + 0.05 * from_centre)
    expected = 0.05 * float(from_centre.norm(dim=1).median()) / graph.pixel_scale
    assert flow_beyond_turns(graph) == pytest.approx(expected, rel=0.05)


def test_sliding_along_a_far_wall_looks_like_a_turn():
    slid = GRID.pixels + GRID.pixels.new_tensor([5.0, 0.0])
    graph = seen_moving(slid)
    assert flow_beyond_turns(graph) < 0.2 * 5 / graph.pixel_scale


def test_without_links_or_weight_there_is_no_parallax():
    assert flow_beyond_turns(true_graph([0, 1])) is None
    graph = true_graph([0, 1])
    graph.match([(0, 1), (1, 0)])
    graph.keyframes.static_weights.zero_()
    assert flow_beyond_turns(graph) is None


# Turns alone


def test_turns_are_found_whatever_depth_and_place_were_thought_to_be():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    turns = [se3_exp(torch.tensor([0, 0, 0, *r], dtype=torch.float64)) for r in TURNS]
    for (source, target), positions in zip(graph.edges.ends, graph.edges.targets, strict=True):
        rays = graph.grid.rays.double() @ (turns[target] @ se3_inverse(turns[source]))[:3, :3].T
        positions.copy_(CAMERA.project(rays).T)
    adjustments = graph.adjustments
    adjust_turns(graph)
    poses = graph.keyframes.T_camera_world
    pairs = zip(poses, turns, strict=True)
    assert max(float(se3_log(pose @ se3_inverse(T)).norm()) for pose, T in pairs) < 1e-5
    assert not poses[:, :3, 3].any()
    assert not graph.keyframes.disparities.any()
    assert graph.adjustments == adjustments + 1 and graph.failed_adjustments == 0


def test_turns_that_cannot_be_solved_change_nothing(monkeypatch: pytest.MonkeyPatch):
    graph = true_graph([0, 1])
    graph.match([(0, 1), (1, 0)])
    before = BundleState(graph.state.T_camera_world.clone(), graph.state.disparities.clone())

    def singular(S: Tensor) -> tuple[Tensor, bool]:
        return S, True

    monkeypatch.setattr(torch.linalg, "cholesky_ex", singular)
    adjust_turns(graph)
    assert graph.failed_adjustments == 1
    assert_same_bits(graph.state, before)
