"""Steps of the bundle adjustment that must not be taken, and degenerate problems."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp
from minislam.tracking import bundle_adjustment
from minislam.tracking.bundle_adjustment import (
    MAX_DAMPING,
    MIN_DISPARITY,
    BundleState,
    bundle_adjust,
    residuals,
)
from minislam.tracking.safeguards.robust import RobustKernel
from tests.tracking.scene import (
    assert_same_bits,
    distance,
    known_problem,
    noisy,
    perturbed,
    two_fixed_poses,
    with_prior,
)

# Steps that are not taken


def scaled_disparities(state: BundleState, factor: float) -> BundleState:
    return replace(state, disparities=factor * state.disparities)


def spoil_steps(
    monkeypatch: pytest.MonkeyPatch, is_bad: Callable[[list[float]], bool]
) -> list[float]:
    """Replace steps by bad ones; return the list that will hold the dampings tried so far."""
    solve, dampings = bundle_adjustment._damped_step, []

    def step(problem, state, equations, damping, absolute_damping):
        dampings.append(damping)
        if is_bad(dampings):
            return scaled_disparities(state, 3.0)
        return solve(problem, state, equations, damping, absolute_damping)

    monkeypatch.setattr(bundle_adjustment, "_damped_step", step)
    return dampings


@pytest.mark.parametrize("robust", [None, RobustKernel(1.0, 1), RobustKernel(3.0)])
def test_cost_never_rises_over_accepted_steps(robust):
    known = known_problem()
    problem = replace(noisy(known, 1.0), robust=robust)
    start = perturbed(known, 0.15)  # far off: undamped steps overshoot
    costs = [bundle_adjust(problem, start, n)[1].cost_after for n in range(9)]
    assert costs[0] == bundle_adjust(problem, start, 3)[1].cost_before
    assert all(later <= earlier for earlier, later in pairwise(costs))
    assert costs[-1] < 0.3 * costs[0]


def test_a_step_that_raises_the_cost_is_tried_again_with_more_damping(monkeypatch):
    known = known_problem()
    start = perturbed(known, 0.02)
    dampings = spoil_steps(monkeypatch, lambda tried: tried[-1] < 0.05)
    end, report = bundle_adjust(known.problem, start, iterations=1)
    assert dampings == pytest.approx([1e-4, 1e-3, 1e-2, 1e-1])
    assert report.iterations == 1 and report.cost_after < report.cost_before
    assert distance(end, start) > 0


def test_damping_falls_by_ten_after_each_good_step_and_no_lower_than_given(monkeypatch):
    known = known_problem()
    start = perturbed(known, 0.02)
    dampings = spoil_steps(monkeypatch, lambda tried: len(tried) <= 3)
    _, report = bundle_adjust(known.problem, start, iterations=4, damping=1e-3)
    assert dampings == pytest.approx([1e-3, 1e-2, 1e-1, 1.0, 1e-1, 1e-2, 1e-3])
    assert report.iterations == 4 and report.damping == pytest.approx(1e-3)


@pytest.mark.parametrize("factor", [3.0, 1.001, 1.00001])
def test_steps_that_only_raise_the_cost_leave_the_state_as_it_was(factor: float, monkeypatch):
    known = known_problem()
    start = scaled_disparities(perturbed(known, 0.01), 1.05)  # larger still is worse still

    def worse(problem, state, equations, damping, absolute_damping):
        return scaled_disparities(state, factor)

    monkeypatch.setattr(bundle_adjustment, "_damped_step", worse)
    end, report = bundle_adjust(known.problem, start, iterations=5)
    assert_same_bits(end, start)
    assert report.cost_after == report.cost_before and report.iterations == 0
    assert report.converged and report.damping > MAX_DAMPING


@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_singular_equations_leave_the_state_as_it_was(damping: float):
    known = known_problem()
    blind = replace(known.problem, weights=torch.zeros_like(known.problem.weights))
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(blind, start, 5, damping=damping, absolute_damping=0.0)
    assert_same_bits(end, start)
    assert not report.converged and report.iterations == 0


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_targets_that_are_no_numbers_leave_the_state_as_it_was(value: float):
    known = known_problem()
    targets = known.problem.targets.clone()
    targets[3, 0, 5] = value
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(replace(known.problem, targets=targets), start, iterations=5)
    assert_same_bits(end, start)
    assert not report.converged and report.iterations == 0


# Degenerate input


def test_at_the_truth_nothing_moves_and_that_is_convergence():
    known = two_fixed_poses(known_problem())
    end, report = bundle_adjust(known.problem, known.truth, iterations=5)
    assert distance(end, known.truth) < 1e-12
    assert report.converged and report.cost_after < 1e-18


def test_a_cell_that_nothing_observes_keeps_its_disparity():
    known = two_fixed_poses(known_problem())
    weights = known.problem.weights.clone()
    weights[known.problem.edges_source == 2, :, 11] = 0
    start = perturbed(known, 0.02)
    end, _ = bundle_adjust(replace(known.problem, weights=weights), start, iterations=5)
    assert end.disparities[2, 11] == start.disparities[2, 11]
    assert (end.disparities != start.disparities).sum() == end.disparities.numel() - 1


def test_a_keyframe_without_edges_follows_its_prior_alone():
    known = with_prior(known_problem(), weight=3.0)
    chosen = (known.problem.edges_source != 3) & (known.problem.edges_target != 3)
    problem = replace(
        known.problem,
        edges_source=known.problem.edges_source[chosen],
        edges_target=known.problem.edges_target[chosen],
        targets=known.problem.targets[chosen],
        weights=known.problem.weights[chosen],
    )
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(problem, start, iterations=4)
    assert report.converged
    torch.testing.assert_close(end.T_camera_world[3], start.T_camera_world[3], rtol=0, atol=1e-14)
    before = (start.disparities[3] - known.truth.disparities[3]).abs().max()
    assert (end.disparities[3] - known.truth.disparities[3]).abs().max() < 0.2 * before


@pytest.mark.parametrize("robust", [None, RobustKernel(2.0)])
def test_without_any_edge_poses_stay_and_disparities_follow_their_prior(robust):
    known = with_prior(known_problem(), weight=3.0)
    none = torch.zeros(0, dtype=torch.long)
    problem = replace(
        known.problem,
        edges_source=none,
        edges_target=none,
        targets=known.problem.targets[:0],
        weights=known.problem.weights[:0],
        robust=robust,
    )
    start = perturbed(known, 0.02)
    end, report = bundle_adjust(problem, start, iterations=4)
    torch.testing.assert_close(end.T_camera_world, start.T_camera_world, rtol=0, atol=1e-14)
    torch.testing.assert_close(end.disparities, known.truth.disparities)
    assert report.converged


def test_a_held_disparity_of_zero_is_a_point_at_infinity():
    known = known_problem()
    disparities = known.truth.disparities.clone()
    disparities[3] = 0
    held = torch.tensor([True, True, True, False])
    problem = replace(known.problem, free_disparities=held)
    end, report = bundle_adjust(problem, BundleState(known.truth.T_camera_world, disparities), 3)
    assert report.iterations > 0 and (end.disparities[3] == 0).all()


def test_all_poses_fixed_refines_disparities():
    known = known_problem()
    problem = replace(known.problem, free_poses=torch.zeros(4, dtype=torch.bool))
    start = perturbed(replace(known, problem=problem), 0.05)
    end, _ = bundle_adjust(problem, start, iterations=10)
    assert_same_bits(replace(end, disparities=start.disparities), start)
    assert distance(end, known.truth) < 1e-8


def test_disparities_stay_positive():
    known = two_fixed_poses(known_problem())
    wrong_way = known.problem.targets.clone()
    outgoing = known.problem.edges_source == 2
    moved: Tensor = residuals(known.problem, BundleState(
        known.truth.T_camera_world, torch.full_like(known.truth.disparities, 1e-9)
    ))[0]  # fmt: skip
    wrong_way[outgoing] -= 2 * moved[outgoing]  # mirrored at the point at infinity
    end, _ = bundle_adjust(replace(known.problem, targets=wrong_way), known.truth, iterations=8)
    assert end.disparities.min() >= MIN_DISPARITY
    assert (end.disparities[2] == MIN_DISPARITY).any()


def test_points_behind_the_target_have_no_weight():
    known = known_problem(2)
    poses = known.truth.T_camera_world.clone()
    poses[1, 2, 3] -= 3.0  # depth ratio 1 - 3 d is below 0.25 for d > 0.25
    residual, weight = residuals(known.problem, BundleState(poses, known.truth.disparities))
    assert torch.isfinite(residual).all()
    forward = weight[0] == 0
    assert forward.any() and not forward.all()


@pytest.mark.parametrize("robust", [None, RobustKernel(2.0)])
def test_looking_away_does_not_pay(robust):
    # Without a price for points behind the camera, the state with no valid point costs nothing.
    known = known_problem(2)
    problem = replace(known.problem, robust=robust)
    poses = known.truth.T_camera_world.clone()
    poses[1] = se3_exp(torch.tensor([0, 0, 0, 0, torch.pi, 0], dtype=torch.float64)) @ poses[1]
    away = BundleState(poses, known.truth.disparities)
    assert not residuals(problem, away)[1].any()
    cost_away = bundle_adjust(problem, away, iterations=0)[1].cost_after
    assert cost_away > bundle_adjust(problem, perturbed(known, 0.1), 0)[1].cost_after > 0


def test_float32_cells_with_float64_poses():
    known = two_fixed_poses(known_problem())
    problem = replace(
        known.problem,
        **{
            name: getattr(known.problem, name).float()
            for name in ("rays", "targets", "weights", "prior_disparities", "prior_weights")
        },
    )
    start = perturbed(known, 0.02)
    start = BundleState(start.T_camera_world, start.disparities.float())
    end, _ = bundle_adjust(problem, start, iterations=10)
    assert end.T_camera_world.dtype == torch.float64 and end.disparities.dtype == torch.float32
    assert distance(end, known.truth) < 1e-4
