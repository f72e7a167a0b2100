"""The column of the focal length: its derivative by hand, by differences and by autograd."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.tracking.bundle_adjustment import bundle_adjust, normal_equations
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.reference import moved, predicted_positions
from minislam.tracking.reprojection import reproject
from minislam.tracking.safeguards.focal_column import focal_jacobian, within_reach, zoomed
from minislam.tracking.safeguards.robust import RobustKernel
from tests.tracking.scene import (
    CAMERA,
    CELLS,
    RAYS,
    distance,
    known_problem,
    noisy,
    perturbed,
    pose_equations,
    two_fixed_poses,
    uniform,
)


def some_edges() -> tuple[Tensor, Tensor]:
    """Return transforms (3, 4, 4) that turn and move, and disparities (3, N)."""
    xi = torch.tensor([[0.3, -0.1, 0.2, 0.1, -0.2, 0.05]], dtype=torch.float64)
    return se3_exp(torch.tensor([[0.5], [1.0], [-1.0]]) * xi), 0.1 + uniform(3, 3, CELLS)


def zoomed_by_autograd(s: Tensor) -> tuple[Camera, Tensor]:
    """Return camera and rays as `zoomed`, differentiable by s, which may be a tensor."""
    factor = s.exp()
    camera = replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)
    ones = torch.ones((), dtype=torch.float64)
    return camera, RAYS / torch.stack([factor, factor, ones])


# Known answers


def test_a_camera_that_stands_still_sees_every_cell_where_it_is_whatever_its_focal_length():
    still = torch.eye(4, dtype=torch.float64)[None]
    J = focal_jacobian(still, uniform(1, 1, CELLS), RAYS, CAMERA)
    torch.testing.assert_close(J, torch.zeros_like(J))


def test_a_step_sideways_is_seen_larger_by_a_longer_focal_length():
    # u' = u + fx d t_x, so du'/ds = fx d t_x.
    step = torch.eye(4, dtype=torch.float64)[None].clone()
    step[0, 0, 3], disparities = 0.5, uniform(1, 1, CELLS)
    J = focal_jacobian(step, disparities, RAYS, CAMERA)
    torch.testing.assert_close(J[:, 0], 60 * 0.5 * disparities)
    torch.testing.assert_close(J[:, 1], torch.zeros_like(J[:, 1]))


def test_zooming_keeps_pixels_and_the_ratio_of_the_focal_lengths():
    camera, rays = zoomed(CAMERA, RAYS, math.log(1.25))
    assert (camera.fx, camera.fy) == pytest.approx((75.0, 82.5))
    torch.testing.assert_close(camera.project(rays), CAMERA.project(RAYS))
    assert zoomed(CAMERA, RAYS, 0.0) == (CAMERA, RAYS)


# Derivatives


def test_the_jacobian_is_that_of_finite_differences():
    transforms, disparities = some_edges()
    h = 1e-5
    ahead, behind = (
        reproject(transforms, disparities, *reversed(zoomed(CAMERA, RAYS, s)))[0] for s in (h, -h)
    )
    J = focal_jacobian(transforms, disparities, RAYS, CAMERA)
    torch.testing.assert_close(J, (ahead - behind) / (2 * h), rtol=1e-7, atol=1e-6)


def test_the_jacobian_is_that_of_autograd():
    transforms, disparities = some_edges()

    def positions(s: Tensor) -> Tensor:
        camera, rays = zoomed_by_autograd(s)
        return reproject(transforms, disparities, rays, camera)[0]

    zero = torch.zeros((), dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(positions, zero)
    J = focal_jacobian(transforms, disparities, RAYS, CAMERA)
    torch.testing.assert_close(J, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("robust", [None, RobustKernel(1.5)])
def test_normal_equations_are_those_of_all_unknowns_at_once(robust: RobustKernel | None):
    known = known_problem(3)
    problem = replace(noisy(known, 0.3), free_focal=True, robust=robust)
    start = perturbed(known, 0.02)
    equations = normal_equations(problem, start)
    poses = 6 * int(problem.free_poses.sum())

    def predicted(step: Tensor) -> Tensor:  # poses, s, disparities
        camera, rays = zoomed_by_autograd(step[poses])
        without = torch.cat([step[:poses], step[poses + 1 :]])
        state = moved(problem, start, without)
        return predicted_positions(replace(problem, camera=camera, rays=rays), state)[0]

    nothing = torch.zeros(poses + 1 + 3 * CELLS, dtype=torch.float64)
    residual = problem.targets - predicted(nothing)
    weight = problem.weights
    if robust is not None:
        weight = weight * robust.weight(residual.square().sum(1, keepdim=True))
    J = torch.autograd.functional.jacobian(predicted, nothing).flatten(0, 2)
    weighted = weight.flatten()[:, None] * J
    matrix, vector = weighted.T @ J, weighted.T @ residual.flatten()

    H, g = pose_equations(problem, start)
    torch.testing.assert_close(H, matrix[: poses + 1, : poses + 1])
    torch.testing.assert_close(g, vector[: poses + 1])
    E = torch.zeros(poses + 1, 3, CELLS, dtype=torch.float64)
    for source, rows, block in equations.source_blocks:
        E[rows, source] += block
    torch.testing.assert_close(E.flatten(1), matrix[: poses + 1, poses + 1 :])


# What an adjustment does with it


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_the_true_focal_length_is_found_with_poses_and_disparities(factor: float):
    known = two_fixed_poses(known_problem(6))
    camera, rays = zoomed(CAMERA, RAYS, math.log(factor))
    problem = replace(known.problem, camera=camera, rays=rays, free_focal=True)
    end, report = bundle_adjust(problem, perturbed(known, 0.01), iterations=60)
    assert math.exp(end.log_focal) * factor == pytest.approx(1, abs=1e-6)
    assert distance(end, known.truth) < 1e-4
    assert report.cost_after < 1e-6 * report.cost_before


def test_a_focal_length_that_is_not_free_stays_and_is_used():
    known = two_fixed_poses(known_problem())
    camera, rays = zoomed(CAMERA, RAYS, math.log(1.2))
    problem = replace(known.problem, camera=camera, rays=rays)
    start = perturbed(known, 0.02)
    back = -math.log(1.2)
    start = BundleState(start.T_camera_world, start.disparities, log_focal=back)
    end, _ = bundle_adjust(problem, start, iterations=10)
    assert end.log_focal == back
    assert distance(end, known.truth) < 1e-8


def test_where_nothing_moves_the_focal_length_stays_that_of_a_lens():
    assert within_reach(0.3) == 0.3
    assert within_reach(40.0) == -within_reach(-40.0) == pytest.approx(math.log(20))
