"""Settled disparities: information against numbers, and an outlier that must not spread."""

import math

import pytest
import torch

from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.safeguards.settling import (
    HANDED_ON,
    SETTLED,
    Settling,
    measured_information,
)
from tests.tracking.wall import GRID, true_graph, true_poses


def test_a_just_settled_cell_counts_half_and_a_prior_wholly():
    graph = true_graph([0, 1])
    graph.keyframes.prior_disparities[1, 3] = 0.2
    information = torch.zeros(len(GRID.rays))
    information[1:3] = torch.tensor([SETTLED, math.inf])
    found = Settling(graph).certainty(information)
    assert found[:4].tolist() == pytest.approx([0.05, 0.5, 1.0, 1.0])


def test_information_is_the_curvature_of_the_cost_in_the_logarithm_of_a_disparity():
    graph = true_graph([0, 1, 2, 3])
    graph.match([(3, 0), (3, 1), (3, 2), (0, 3)])
    found = measured_information(graph, 3)
    problem = bundle_problem(graph, [0, 1, 2])
    at, cell, step = graph.state, len(GRID.rays) // 2, 1e-2
    shifts = []
    for sign in (-1, 1):
        graph.keyframes.set_geometry(at.T_camera_world, at.disparities.clone())
        graph.keyframes.disparities[3, cell] *= 1 + sign * step
        residual, _ = residuals(problem, graph.state)
        shifts.append(residual[:, :, cell])
    derivative = (shifts[1] - shifts[0]) / (2 * step)
    expected = (problem.weights[:, :, cell] * derivative.square()).sum()
    torch.testing.assert_close(found[cell], expected, rtol=2e-2, atol=0)


def test_without_edges_nothing_is_known():
    assert measured_information(true_graph([0, 1]), 1).sum() == 0


def test_an_unsettled_outlier_is_not_handed_on():
    graph = true_graph([0, 1])
    settling = Settling(graph)
    information = torch.full((len(GRID.rays),), 4 * SETTLED)
    information[::7] = 0.0
    graph.keyframes.disparities[1, ::7] = 0.6
    assert graph.warp_disparities(1, true_poses()[2]).max() > 0.5
    disparities = settling.hand_on(information, true_poses()[2])
    assert disparities.max() < 0.4
    assert 0 < float(settling.handed_on.max()) <= HANDED_ON * 4 * SETTLED + 1e-3


def test_where_nothing_is_settled_all_is_handed_on():
    graph = true_graph([0, 1])
    nothing = torch.zeros(len(GRID.rays))
    disparities = Settling(graph).hand_on(nothing, true_poses()[2])
    assert torch.equal(disparities, graph.warp_disparities(1, true_poses()[2]))


def test_a_depth_prior_is_handed_on_but_settles_nothing():
    graph = true_graph([0, 1])
    graph.match([(1, 0)])
    settling = Settling(graph)
    measured = settling.information()
    graph.keyframes.prior_disparities[1] = 0.2
    assert torch.equal(settling.information(), measured)
    nothing = torch.zeros_like(measured)
    nothing[0] = 2 * SETTLED
    disparities = settling.hand_on(nothing, true_poses()[2])
    assert torch.equal(disparities, graph.warp_disparities(1, true_poses()[2]))
    assert (settling.handed_on > 0).float().mean() < 0.05


@pytest.mark.parametrize("count", [3, 5])
def test_the_information_of_the_newest_keyframe_includes_what_was_handed_on(count: int):
    graph = true_graph(list(range(count)))
    graph.match([(count - 1, 0)])
    settling = Settling(graph)
    settling.handed_on += 7.0
    expected = measured_information(graph, count - 1) + 7.0
    torch.testing.assert_close(settling.information(), expected)
    graph.flow_to_next[-1] = None  # the camera was lost: nothing could be handed on
    torch.testing.assert_close(settling.information(), expected - 7.0)


def test_where_flow_has_not_settled_a_start_the_prior_stays():
    graph = true_graph([0, 1, 2])
    graph.match([(0, 1), (1, 0), (1, 2), (2, 1)])
    graph.keyframes.prior_disparities[:2] = 0.7
    graph.keyframes.prior_disparities[1, 3] = 0
    before, settled = graph.keyframes.disparities.clone(), torch.zeros(3, len(GRID.rays)).bool()
    for index in range(3):
        settled[index] = measured_information(graph, index) > SETTLED
    assert settled.any() and not settled.all()
    Settling(graph).fall_back_on_prior()
    expected = torch.where(settled, before, 0.7)
    expected[2], expected[1, 3] = before[2], before[1, 3]
    assert torch.equal(graph.keyframes.disparities, expected)
