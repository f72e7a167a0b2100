"""Settled disparities: information against numbers, and an outlier that must not spread."""

import torch

from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.safeguards.settling import (
    SETTLED,
    fall_back_on_prior,
    hand_on,
    measured_information,
    settled_cells,
)
from tests.tracking.wall import GRID, true_graph, true_poses


def test_information_is_the_curvature_of_the_cost_in_the_logarithm_of_a_disparity():
    graph = true_graph([0, 1, 2, 3])
    graph.match([(3, 0), (3, 1), (3, 2), (0, 3)])
    found = measured_information(graph, 3)
    problem = bundle_problem(graph, [0, 1, 2], 0)
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
    assert torch.equal(settled_cells(graph, 3), found > SETTLED)


def test_without_edges_nothing_is_known():
    assert measured_information(true_graph([0, 1]), 1).sum() == 0


def test_an_unsettled_outlier_is_not_handed_on():
    graph = true_graph([0, 1])
    settled = torch.ones(len(GRID.rays), dtype=torch.bool)
    settled[::7] = False
    graph.keyframes.disparities[1, ::7] = 0.6
    assert graph.warp_disparities(1, true_poses()[2]).max() > 0.5
    assert hand_on(graph, settled, true_poses()[2]).max() < 0.4


def test_where_nothing_is_settled_all_is_handed_on():
    graph = true_graph([0, 1])
    disparities = hand_on(graph, torch.zeros(len(GRID.rays)).bool(), true_poses()[2])
    assert torch.equal(disparities, graph.warp_disparities(1, true_poses()[2]))


def test_a_depth_prior_is_handed_on_but_settles_nothing():
    graph = true_graph([0, 1])
    graph.match([(1, 0)])
    measured = measured_information(graph, 1)
    graph.keyframes.prior_disparities[1] = 0.2
    assert torch.equal(measured_information(graph, 1), measured)
    one = torch.zeros(len(GRID.rays)).bool()
    one[0] = True
    disparities = hand_on(graph, one, true_poses()[2])
    assert torch.equal(disparities, graph.warp_disparities(1, true_poses()[2]))


def test_where_flow_has_not_settled_a_start_the_prior_stays():
    graph = true_graph([0, 1, 2])
    graph.match([(0, 1), (1, 0), (1, 2), (2, 1)])
    graph.keyframes.prior_disparities[:2] = 0.7
    graph.keyframes.prior_disparities[1, 3] = 0
    before = graph.keyframes.disparities.clone()
    settled = torch.stack([settled_cells(graph, index) for index in range(3)])
    assert settled.any() and not settled.all()
    fall_back_on_prior(graph)
    expected = torch.where(settled, before, 0.7)
    expected[2], expected[1, 3] = before[2], before[1, 3]
    assert torch.equal(graph.keyframes.disparities, expected)
