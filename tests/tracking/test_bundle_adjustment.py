"""Bundle adjustment against the dense twin and against the truth."""

from dataclasses import replace

import pytest
import torch

from minislam.geometry import se3_exp
from minislam.tracking import bundle_adjustment
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleState,
    bundle_adjust,
    edge_costs,
    normal_equations,
    residuals,
)
from minislam.tracking.reference import dense_normal_equations, dense_step
from minislam.tracking.safeguards.robust import RobustKernel
from tests.tracking.scene import (
    CELLS,
    assert_same_bits,
    distance,
    known_problem,
    noisy,
    normal,
    perturbed,
    pose_equations,
    scaled,
    two_fixed_poses,
    uniform,
    with_prior,
)

# Plain least squares, Cauchy, Geman-McClure.
ROBUST = [None, RobustKernel(1.5, 1), RobustKernel(1.5)]


def one_step(problem: BundleProblem, state: BundleState, damping: float, absolute: float):
    equations = normal_equations(problem, state)
    after = bundle_adjustment._damped_step(problem, state, equations, damping, absolute)
    assert after is not None
    return after


# Known answers


@pytest.mark.parametrize("seed", [0, 100])
def test_a_disturbed_state_returns_to_the_truth(seed: int):
    known = two_fixed_poses(known_problem(seed=seed))
    start = perturbed(known, 0.02)
    assert distance(start, known.truth) > 0.02
    end, report = bundle_adjust(known.problem, start, iterations=10)
    assert distance(end, known.truth) < 1e-8
    assert report.converged and report.cost_after < 1e-12 * report.cost_before


def test_without_a_prior_the_truth_is_found_up_to_scale():
    known = known_problem()
    end, _ = bundle_adjust(known.problem, perturbed(known, 0.02), iterations=10)
    factor = float((end.disparities / known.truth.disparities).median())
    assert distance(scaled(end, factor), known.truth) < 1e-8


def test_the_prior_pulls_the_scale():
    known = with_prior(known_problem(), weight=50.0)
    start = scaled(known.truth, 1.3)
    without, _ = bundle_adjust(known_problem().problem, start, iterations=20)
    assert distance(without, start) < 1e-8  # every scale explains the flow
    pulled, _ = bundle_adjust(known.problem, start, iterations=20)
    assert distance(pulled, known.truth) < 1e-5


def test_robust_weights_recover_from_thirty_percent_outliers():
    known = two_fixed_poses(known_problem())
    targets = known.problem.targets
    is_outlier = (uniform(70, len(targets), 1, CELLS) < 0.3).expand_as(targets)
    spoilt = torch.where(is_outlier, targets + 25 * normal(71, *targets.shape), targets)
    plain = replace(known.problem, targets=spoilt)
    robust = replace(plain, robust=RobustKernel(0.5))
    start = perturbed(known, 0.01)
    misled, _ = bundle_adjust(plain, start, iterations=20)
    recovered, _ = bundle_adjust(robust, start, iterations=20)
    error = (recovered.T_camera_world - known.truth.T_camera_world).abs().max()
    plain_error = (misled.T_camera_world - known.truth.T_camera_world).abs().max()
    assert error < 2e-3
    assert error < 0.02 * plain_error


def test_edge_costs_by_hand():
    known = known_problem(2)
    targets = known.problem.targets + torch.tensor([3.0, 4.0])[:, None]
    weights = 0.5 * torch.ones_like(targets)
    plain = replace(known.problem, targets=targets, weights=weights)
    robust = replace(plain, robust=RobustKernel(2.5))
    # |r|^2 = 25 px^2 in every cell; Geman-McClure: c^2 r^2 / (r^2 + c^2) = 6.25 * 25 / 31.25 = 5.
    both = torch.ones(2, dtype=torch.float64) * CELLS * 0.5
    torch.testing.assert_close(edge_costs(plain, known.truth), 25 * both)
    torch.testing.assert_close(edge_costs(robust, known.truth), 5 * both)


def test_cauchy_weights_by_hand():
    known = known_problem(2)
    shift = torch.tensor([3.0, 4.0])[:, None]
    problem = replace(
        known.problem, targets=known.problem.targets + shift, robust=RobustKernel(2.5, 1)
    )
    residual, weight = residuals(problem, known.truth)
    torch.testing.assert_close(residual, shift.double().expand_as(residual))
    torch.testing.assert_close(weight, problem.weights / (1 + 25 / 6.25))  # |r| = 5 px


# Identities


@pytest.mark.parametrize("robust", ROBUST)
@pytest.mark.parametrize(("damping", "absolute"), [(0.0, 0.0), (1e-2, 1e-3)])
def test_elimination_of_disparities_changes_nothing(robust, damping: float, absolute: float):
    known = with_prior(known_problem(3), weight=3.0)
    problem = replace(noisy(known, 1.0), robust=robust)
    start = perturbed(known, 0.02)
    eliminated = one_step(problem, start, damping, absolute)
    assert distance(eliminated, start) > 0.01
    assert distance(eliminated, dense_step(problem, start, damping, absolute)) < 1e-9


def test_elimination_with_some_disparities_and_poses_held():
    known = with_prior(known_problem(3), weight=3.0)
    problem = replace(
        noisy(known, 1.0),
        free_poses=torch.tensor([False, False, True]),
        free_disparities=torch.tensor([True, False, True]),
    )
    start = perturbed(known, 0.02)
    eliminated = one_step(problem, start, 0.0, 0.0)
    assert distance(eliminated, dense_step(problem, start, 0.0, 0.0)) < 1e-9


def test_normal_equations_are_those_of_the_dense_twin():
    known = with_prior(known_problem(3), weight=3.0)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    ours = normal_equations(problem, start)
    dense = dense_normal_equations(problem, start)
    split = dense.pose_unknowns
    assert split == 12
    close = {"rtol": 1e-10, "atol": 1e-9}
    H, g = pose_equations(problem, start)
    torch.testing.assert_close(H, dense.matrix[:split, :split], **close)
    torch.testing.assert_close(g, dense.vector[:split], **close)
    C = dense.matrix[split:, split:]
    torch.testing.assert_close(ours.disparity_diagonal.reshape(-1), C.diagonal(), **close)
    assert (C - torch.diag(C.diagonal())).abs().max() < 1e-9  # a disparity has one source only
    torch.testing.assert_close(ours.disparity_gradient.reshape(-1), dense.vector[split:], **close)


@pytest.mark.parametrize("robust", ROBUST)
def test_the_gradient_is_that_of_the_cost(robust):
    # d cost = -2 (g . xi + s . dd): the weights of the solve belong to the cost that is reported.
    known = with_prior(known_problem(3), weight=3.0)
    weights = known.problem.weights.mean(1, keepdim=True).expand_as(known.problem.weights)
    problem = replace(noisy(known, 1.0), robust=robust, weights=weights)
    start, step = perturbed(known, 0.02), 1e-6
    equations = normal_equations(problem, start)
    xi, added = normal(5, 2, 6), normal(6, 3, CELLS)
    costs = []
    for sign in (1, -1):
        poses = start.T_camera_world.clone()
        poses[1:] = se3_exp(sign * step * xi) @ poses[1:]
        moved = BundleState(poses, start.disparities + sign * step * added)
        costs.append(bundle_adjustment._cost(problem, moved))
    slope = (costs[0] - costs[1]) / (2 * step)
    predicted = pose_equations(problem, start)[1] @ xi.reshape(-1)
    predicted = -2 * (predicted + (equations.disparity_gradient * added).sum())
    assert slope == pytest.approx(float(predicted), rel=1e-6)


@pytest.mark.parametrize("robust", ROBUST)
def test_the_cost_is_that_of_the_edges_and_of_the_prior(robust):
    known = with_prior(known_problem(), weight=3.0)
    problem, state = replace(noisy(known, 1.0), robust=robust), perturbed(known, 0.02)
    costs = edge_costs(problem, state)
    assert costs.shape == (len(problem.edges_source),)
    prior = (problem.prior_weights * (state.disparities - problem.prior_disparities) ** 2).sum()
    _, report = bundle_adjust(problem, state, iterations=0)
    assert report.cost_before == pytest.approx(float(costs.sum() + prior), rel=1e-12)
    weights = problem.weights.clone()
    weights[3] = 0
    without = edge_costs(replace(problem, weights=weights), state)
    torch.testing.assert_close(without, costs * (torch.arange(len(costs)) != 3))


def test_a_weight_of_zero_removes_a_cell_exactly():
    known = with_prior(known_problem(), weight=3.0)
    weights = known.problem.weights.clone()
    weights[2, :, 17] = 0
    removed = replace(known.problem, weights=weights)
    targets = removed.targets.clone()
    targets[2, :, 17] += 1e3
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(removed, start, iterations=3)
    other, other_report = bundle_adjust(replace(removed, targets=targets), start, iterations=3)
    assert_same_bits(end, other)
    assert report == other_report


def test_an_edge_of_zero_weight_might_as_well_not_be_there():
    known = with_prior(known_problem(), weight=3.0)
    problem = noisy(known, 1.0)
    weights = problem.weights.clone()
    weights[-1] = 0
    shorter = replace(
        problem,
        edges_source=problem.edges_source[:-1],
        edges_target=problem.edges_target[:-1],
        targets=problem.targets[:-1],
        weights=problem.weights[:-1],
    )
    start = perturbed(known, 0.02)
    end, _ = bundle_adjust(replace(problem, weights=weights), start, iterations=3)
    expected, _ = bundle_adjust(shorter, start, iterations=3)
    assert distance(end, expected) < 1e-12


@pytest.mark.parametrize("robust", ROBUST)
def test_doubled_weights_change_nothing(robust):
    known = two_fixed_poses(known_problem())
    problem = replace(noisy(known, 1.0), robust=robust)
    doubled = replace(problem, weights=2 * problem.weights)
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(problem, start, 3, damping=0.0, absolute_damping=0.0)
    other, doubled_report = bundle_adjust(doubled, start, 3, damping=0.0, absolute_damping=0.0)
    assert distance(end, other) < 1e-12
    assert doubled_report.cost_after == pytest.approx(2 * report.cost_after, rel=1e-12)


def test_the_order_of_edges_does_not_matter():
    known = with_prior(known_problem(), weight=3.0)
    problem, order = noisy(known, 1.0), torch.arange(12).flip(0)
    shuffled = replace(
        problem,
        edges_source=problem.edges_source[order],
        edges_target=problem.edges_target[order],
        targets=problem.targets[order],
        weights=problem.weights[order],
    )
    start = perturbed(known, 0.02)
    end, _ = bundle_adjust(problem, start, iterations=3)
    assert distance(end, bundle_adjust(shuffled, start, iterations=3)[0]) < 1e-12


def test_what_is_fixed_keeps_its_bits():
    known = known_problem()
    free_poses = torch.tensor([False, True, False, True])
    free_disparities = torch.tensor([True, False, False, True])
    problem = replace(noisy(known, 1.0), free_poses=free_poses, free_disparities=free_disparities)
    start = perturbed(known_problem(), 0.02)
    end, report = bundle_adjust(problem, start, iterations=4)
    assert report.iterations > 0
    for index in range(4):
        same_pose = torch.equal(end.T_camera_world[index], start.T_camera_world[index])
        same_disparity = torch.equal(end.disparities[index], start.disparities[index])
        assert same_pose == (not free_poses[index])
        assert same_disparity == (not free_disparities[index])


def test_motion_only_moves_poses_to_the_truth_and_no_disparity():
    known = known_problem()
    held = torch.zeros(4, dtype=torch.bool)
    start = perturbed(
        replace(known, problem=replace(known.problem, free_disparities=held)), size=0.05
    )
    held = torch.zeros_like(known.problem.free_disparities)
    end, _ = bundle_adjust(replace(known.problem, free_disparities=held), start, iterations=8)
    assert torch.equal(end.disparities, start.disparities)
    assert distance(end, known.truth) < 1e-8


def test_the_given_state_is_left_alone():
    known = known_problem()
    start = perturbed(known, 0.02)
    copy = BundleState(start.T_camera_world.clone(), start.disparities.clone())
    bundle_adjust(known.problem, start, iterations=3)
    assert_same_bits(start, copy)
