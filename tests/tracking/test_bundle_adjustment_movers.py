"""The paper's claim in small: weights from beta hold the camera where a part of the view moves."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.tracking.bundle_adjustment import BundleProblem, BundleState, bundle_adjust
from minislam.tracking.reprojection import reproject
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.uncertainty.weights import beta_of_mask, relative_weight, tracking_weight
from tests.tracking.scene import (
    CAMERA,
    CELLS,
    RAYS,
    STRIDE,
    KnownProblem,
    known_problem,
    noisy,
    perturbed,
    two_fixed_poses,
    uniform,
)

GRID = (7, 10)  # cells
MOVING = torch.arange(CELLS) % GRID[1] < 3  # the left 30 % of every view
STEP = torch.tensor([0.15, 0.1, 0, 0, 0, 0.02], dtype=torch.float64)  # of the object per keyframe
NOISE = 0.2  # px


def with_mover(known: KnownProblem, flow: BundleProblem) -> BundleProblem:
    """Return the problem whose moving cells follow a rigid object of a motion of its own."""
    problem, poses = known.problem, known.truth.T_camera_world
    source, target = problem.edges_source, problem.edges_target
    T_world_object = se3_exp(torch.arange(len(poses))[:, None] * STEP)
    T_camera_object = poses @ T_world_object
    motion = T_camera_object[target] @ se3_inverse(T_camera_object[source])
    targets, valid = reproject(motion, known.truth.disparities[source], RAYS, CAMERA)
    assert valid.all()
    moved = targets - problem.targets
    assert 4 < moved[:, :, MOVING].norm(dim=1).mean() < 8  # px
    return replace(flow, targets=torch.where(MOVING, flow.targets + moved, flow.targets))


def weighted(problem: BundleProblem, beta: Tensor) -> BundleProblem:
    """Return the problem with the weights that the tracker makes of beta (h, w) of every view."""
    weight = relative_weight(tracking_weight(beta, CAMERA, STRIDE))
    return replace(problem, weights=problem.weights * weight.reshape(-1))


def error_of_camera(known: KnownProblem, problem: BundleProblem) -> float:
    """Return the error of the camera's positions, as a root mean square [world units]."""
    end, _ = bundle_adjust(problem, perturbed(known, 0.01), iterations=20)
    found, true = (positions(state) for state in (end, known.truth))
    return float((found - true).square().sum(-1).mean().sqrt())


def positions(state: BundleState) -> Tensor:
    return se3_inverse(state.T_camera_world)[:, :3, 3]


@pytest.mark.parametrize("robust", [None, RobustKernel(1.0)])
@pytest.mark.parametrize("seed", [0, 10, 20])
def test_with_beta_a_mover_in_thirty_percent_of_the_view_costs_less_than_a_third(robust, seed: int):
    known = two_fixed_poses(known_problem(seed=seed))
    problem = replace(with_mover(known, noisy(known, NOISE)), robust=robust)
    without = error_of_camera(known, problem)
    found = error_of_camera(known, weighted(problem, beta_of_mask(MOVING.reshape(GRID))))
    assert without > 0.03
    assert found < without / 5  # measured: .05 to .11 of it


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_where_nothing_moves_beta_costs_the_camera_nothing(seed: int):
    known = two_fixed_poses(known_problem(seed=seed))
    problem = noisy(known, NOISE)
    # As of a map that explains all of a view, though not every place equally well.
    beta = (0.15 + 0.5 * uniform(seed + 3, *GRID)).float()
    without, found = (error_of_camera(known, p) for p in (problem, weighted(problem, beta)))
    assert found == pytest.approx(without, rel=0.1)  # measured: 3 %
