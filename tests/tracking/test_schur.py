"""The Schur complement against the dense twin, where every unknown is kept."""

import pytest
import torch

from minislam.tracking.bundle_adjustment import normal_equations
from minislam.tracking.reference import dense_normal_equations
from minislam.tracking.schur import marginalised
from tests.tracking.scene import known_problem, noisy, perturbed, with_prior


@pytest.fixture
def linearised():
    known = with_prior(known_problem(3), weight=3.0)
    problem, state = noisy(known, 1.0), perturbed(known, 0.02)
    return problem, dense_normal_equations(problem, state), normal_equations(problem, state)


def test_what_is_left_has_the_solution_and_the_covariance_of_the_whole(linearised):
    problem, dense, equations = linearised
    S, b = marginalised(problem, equations, equations.disparity_diagonal.reciprocal())
    split = dense.pose_unknowns
    solution, covariance = torch.linalg.solve(dense.matrix, dense.vector), dense.matrix.inverse()
    torch.testing.assert_close(torch.linalg.solve(S, b), solution[:split], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(S.inverse(), covariance[:split, :split], rtol=1e-8, atol=1e-10)


def test_disparities_that_are_held_take_nothing_away(linearised):
    problem, dense, equations = linearised
    S, b = marginalised(problem, equations, 0 * equations.disparity_diagonal)
    split = dense.pose_unknowns
    torch.testing.assert_close(S, dense.matrix[:split, :split], rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(b, dense.vector[:split], rtol=1e-10, atol=1e-9)
