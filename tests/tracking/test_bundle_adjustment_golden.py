"""Bundle adjustment against stored answers of the official one.

What differs on purpose, and how it is taken out of the comparison:

* weights: the official code multiplies confidences by 0.001 and disparity priors by 0.05; ours
  are free, so the test sets the same;
* disparity damping: the official code adds eta, an output of its network, where there is no
  prior. Ours has no such network and damps all disparities in proportion to their mean
  curvature. The test puts the official diagonal in its place, divided by 1 + damping because
  ours also applies the pose damping to it.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_adjoint
from minislam.tracking import bundle_adjustment
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleState,
    bundle_adjust,
    normal_equations,
    residuals,
)
from minislam.tracking.reprojection import relative_transforms, reproject_with_jacobians
from tests.helpers import assert_gradients_close
from tests.tracking import golden
from tests.tracking.scene import pose_equations


def damped_diagonal(problem: BundleProblem, diagonal: Tensor) -> Tensor:
    """Return the official diagonal C: with eta wherever there is no prior."""
    return diagonal + golden.golden()["eta"].reshape(6, -1) * (problem.prior_weights == 0)


def official_step(
    problem: BundleProblem, state: BundleState, damping: float, absolute_damping: float
) -> BundleState:
    equations = normal_equations(problem, state)
    diagonal = damped_diagonal(problem, equations.disparity_diagonal) / (1 + damping)
    equations = replace(equations, disparity_diagonal=diagonal)
    after = bundle_adjustment._damped_step(problem, state, equations, damping, absolute_damping)
    assert after is not None
    return after


def assert_states_close(actual: BundleState, expected: BundleState, tolerance: float) -> None:
    for a, b in (
        (actual.T_camera_world, expected.T_camera_world),
        (actual.disparities, expected.disparities),
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


def test_residuals_and_derivatives_of_one_edge():
    g = golden.golden()
    edge = int(g["edge"])
    problem, state = golden.problem(first_free=1, prior=True), golden.state()
    source, target = problem.edges_source[[edge]], problem.edges_target[[edge]]
    transforms = relative_transforms(state.T_camera_world, source, target)
    linear = reproject_with_jacobians(
        transforms, state.disparities[source], problem.rays, problem.camera
    )
    residual, weight = residuals(problem, state)
    torch.testing.assert_close(residual[edge].mT.reshape(6, 8, 2), g["edge_r"], rtol=0, atol=1e-10)
    torch.testing.assert_close(weight[edge].mT.reshape(6, 8, 2), g["edge_w"], rtol=0, atol=1e-12)
    J_target = linear.J_target[0].permute(2, 1, 0)
    J_source = -J_target @ se3_adjoint(transforms[0])
    seen = linear.valid[0].reshape(6, 8)
    assert seen.all()
    for actual, name in (
        (J_target.reshape(6, 8, 2, 6), "edge_Jj"),
        (J_source.reshape(6, 8, 2, 6), "edge_Ji"),
        (linear.J_disparity[0].mT.reshape(6, 8, 2), "edge_Jz"),
    ):
        assert_gradients_close(actual, g[name], relative=1e-10)


def test_normal_equations():
    g = golden.golden()
    problem, state = golden.problem(first_free=1, prior=True), golden.state()
    equations = normal_equations(problem, state)
    diagonal = damped_diagonal(problem, equations.disparity_diagonal)
    H, gradient = pose_equations(problem, state)
    assert_gradients_close(H, g["lin_H"], relative=1e-10)
    assert_gradients_close(gradient.reshape(5, 6), g["lin_g"], relative=1e-10)
    assert_gradients_close(diagonal, g["lin_C"], relative=1e-10)
    assert_gradients_close(equations.disparity_gradient, g["lin_w"], relative=1e-10)


def test_reduced_system():
    g = golden.golden()
    problem = golden.problem(first_free=1, prior=True)
    equations = normal_equations(problem, golden.state())
    S, b = pose_equations(problem, golden.state())
    for source, rows, E in equations.source_blocks:
        S.index_put_((rows[:, None], rows), -(E / g["lin_C"][source]) @ E.mT, accumulate=True)
        b.index_add_(0, rows, -E @ (equations.disparity_gradient / g["lin_C"])[source])
    S.diagonal().mul_(1 + 1e-4).add_(0.1)
    assert_gradients_close(S, g["lin_A"], relative=1e-10)
    assert_gradients_close(b, g["lin_b"], relative=1e-10)
    assert_gradients_close(torch.linalg.solve(S, b).reshape(5, 6), g["lin_dx"], relative=1e-9)


@pytest.mark.parametrize(
    ("case", "first_free", "prior", "damping", "absolute_damping"),
    [
        ("A", 1, True, 1e-4, 0.1),
        ("B", 1, False, 1e-5, 1e-2),
        ("C", 3, True, 1e-4, 0.1),
    ],
    ids=["with prior", "without prior", "three fixed poses"],
)
def test_two_steps(
    case: str,
    first_free: int,
    prior: bool,
    damping: float,
    absolute_damping: float,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(bundle_adjustment, "DISPARITY_DAMPING", 0.0)
    problem, state = golden.problem(first_free, prior), golden.state()
    for _ in range(2):
        state = official_step(problem, state, damping, absolute_damping)
    assert_states_close(state, golden.state(case), 1e-8)


def test_two_steps_of_the_poses_alone_need_no_adaptation():
    problem = replace(
        golden.problem(first_free=4, prior=False), free_disparities=torch.zeros(6, dtype=torch.bool)
    )
    state, report = bundle_adjust(
        problem, golden.state(), iterations=2, damping=1e-4, absolute_damping=0.1
    )
    assert report.iterations == 2 and report.damping == 1e-4
    assert_states_close(state, golden.state("M"), 1e-8)
