"""Reprojection: where a cell is seen, and each derivative through the left retraction."""

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_adjoint, se3_exp, se3_inverse, transform_points
from minislam.tracking.reprojection import (
    MIN_DEPTH_RATIO,
    relative_transforms,
    reproject,
    reproject_with_jacobians,
    scaled_points,
)
from tests.helpers import assert_gradients_close, generator, numerical_jacobian
from tests.tracking.scene import CAMERA, PIXELS, RAYS, normal, poses_on_an_arc, uniform

CHOSEN = slice(3, 60, 8)  # cells all over the image; every cell would only take longer
REGIMES = {
    "normal": (0.4, 0.3),  # size of the motion (units, rad) and of the disparities
    "far": (0.4, 1e-6),
    "still": (1e-9, 0.3),
    "turned": (0.9, 0.3),
}


def two_views(regime: str, seed: int) -> tuple[Tensor, Tensor]:
    """Return the poses (2, 4, 4) of source and target, and the source's disparities (n,)."""
    motion, disparity = REGIMES[regime]
    step = motion * torch.tensor([0.5, 0.3, 0.2, 0.2, -0.3, 0.5]) * normal(seed, 6)
    source = se3_exp(normal(seed + 1, 6))
    poses = torch.stack([source, se3_exp(step) @ source])
    return poses, disparity * (0.5 + uniform(seed + 2, len(RAYS[CHOSEN])))


def positions_after(poses: Tensor, disparities: Tensor, xi: Tensor) -> Tensor:
    """Return the positions (2, n) after left steps xi (2, 6) of source and target."""
    transforms = relative_transforms(se3_exp(xi) @ poses, torch.tensor([0]), torch.tensor([1]))
    return reproject(transforms, disparities[None], RAYS[CHOSEN], CAMERA)[0][0]


def linearised(poses: Tensor, disparities: Tensor):
    transforms = relative_transforms(poses, torch.tensor([0]), torch.tensor([1]))
    return reproject_with_jacobians(transforms, disparities[None], RAYS[CHOSEN], CAMERA)


# Known answers


def test_a_step_to_the_right_moves_the_image_to_the_left_by_fx_t_d():
    T_target_source = torch.eye(4, dtype=torch.float64)[None]
    T_target_source[0, 0, 3] = -0.5  # the camera went right, so the points went left
    disparities = torch.full((1, len(RAYS)), 0.4, dtype=torch.float64)
    positions, valid = reproject(T_target_source, disparities, RAYS, CAMERA)
    # 60 px * 0.5 * 0.4 = 12 px, at every cell, and no vertical motion.
    expected = PIXELS.T - torch.tensor([[12.0], [0.0]])
    torch.testing.assert_close(positions[0], expected, rtol=0, atol=1e-12)
    assert valid.all()


def test_a_point_at_infinity_moves_by_rotation_alone():
    turn = se3_exp(torch.tensor([0.0, 0, 0, 0.02, -0.05, 0.1], dtype=torch.float64))
    moved = turn.clone()
    moved[:3, 3] = torch.tensor([5.0, -3.0, 2.0])
    infinity = torch.zeros(1, len(RAYS), dtype=torch.float64)
    turned, _ = reproject(turn[None], infinity, RAYS, CAMERA)
    both, valid = reproject(moved[None], infinity, RAYS, CAMERA)
    assert torch.equal(turned, both) and valid.all()


# Identities


def test_reprojection_is_the_camera_applied_to_the_moved_point():
    poses, disparities = two_views("normal", 3)
    T_target_source = poses[1] @ se3_inverse(poses[0])
    points = transform_points(T_target_source, RAYS[CHOSEN] / disparities[:, None])
    expected = CAMERA.project(points).mT
    actual = positions_after(poses, disparities, torch.zeros(2, 6, dtype=torch.float64))
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-10)


def test_scaled_points_carry_the_depth_ratio():
    poses, disparities = two_views("normal", 4)
    T_target_source = poses[1] @ se3_inverse(poses[0])
    points = transform_points(T_target_source, RAYS[CHOSEN] / disparities[:, None])
    scaled = scaled_points(T_target_source[None], disparities[None], RAYS[CHOSEN])[0]
    torch.testing.assert_close(scaled, points.T * disparities, rtol=1e-12, atol=1e-12)


def test_relative_transforms_name_the_frames_they_join():
    poses = poses_on_an_arc(4, 0)
    transforms = relative_transforms(poses, torch.tensor([0, 3]), torch.tensor([2, 1]))
    torch.testing.assert_close(transforms[0] @ poses[0], poses[2])
    torch.testing.assert_close(transforms[1] @ poses[3], poses[1])


@pytest.mark.parametrize("regime", REGIMES)
def test_positions_are_the_same_with_and_without_derivatives(regime: str):
    poses, disparities = two_views(regime, 5)
    transforms = relative_transforms(poses, torch.tensor([0]), torch.tensor([1]))
    positions, valid = reproject(transforms, disparities[None], RAYS[CHOSEN], CAMERA)
    linear = linearised(poses, disparities)
    torch.testing.assert_close(positions, linear.positions, rtol=1e-13, atol=1e-12)
    assert torch.equal(valid, linear.valid)


# Gradients


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("seed", [10, 20, 30])
def test_pose_derivatives_through_the_left_retraction(regime: str, seed: int):
    poses, disparities = two_views(regime, seed)
    linear = linearised(poses, disparities)
    assert linear.valid.all()
    T_target_source = poses[1] @ se3_inverse(poses[0])
    J_target = linear.J_target[0].permute(1, 2, 0)  # (2, n, 6)
    J_source = -J_target @ se3_adjoint(T_target_source)

    def positions(xi: Tensor) -> Tensor:
        return positions_after(poses, disparities, xi)

    standing = torch.zeros(2, 6, dtype=torch.float64)
    numerical = numerical_jacobian(positions, standing)
    by_autograd = torch.func.jacrev(positions)(standing)
    for place, J in ((0, J_source), (1, J_target)):
        assert_gradients_close(J, numerical[..., place, :], relative=1e-7)
        assert_gradients_close(J, by_autograd[..., place, :], relative=1e-10)


@pytest.mark.parametrize("regime", ["normal", "far", "turned"])
@pytest.mark.parametrize("seed", [10, 20, 30])
def test_disparity_derivatives(regime: str, seed: int):
    poses, disparities = two_views(regime, seed)
    J = linearised(poses, disparities).J_disparity[0]
    standing = torch.zeros(2, 6, dtype=torch.float64)

    def positions(values: Tensor) -> Tensor:
        return positions_after(poses, values, standing)

    # Each position depends on the disparity of its own cell alone.
    numerical = numerical_jacobian(positions, disparities).diagonal(dim1=1, dim2=2)
    by_autograd = torch.func.jacrev(positions)(disparities).diagonal(dim1=1, dim2=2)
    assert_gradients_close(J, numerical, relative=1e-7)
    assert_gradients_close(J, by_autograd, relative=1e-10)


def test_one_flipped_sign_is_noticed():
    poses, disparities = two_views("normal", 10)
    J = linearised(poses, disparities).J_target[0].permute(1, 2, 0)
    wrong = J.clone()
    wrong[1, 2, 4] *= -1
    with pytest.raises(AssertionError):
        assert_gradients_close(wrong, J, relative=1e-7)


# Degenerate input


def test_points_too_close_or_behind_are_invalid_and_finite():
    T_target_source = torch.eye(4, dtype=torch.float64)[None]
    T_target_source[0, 2, 3] = -1.0  # depth ratio 1 - d
    disparities = torch.tensor([[0.0, 0.7, 0.75, 0.76, 1.0, 1.5]], dtype=torch.float64)
    linear = reproject_with_jacobians(T_target_source, disparities, RAYS[:6], CAMERA)
    assert MIN_DEPTH_RATIO == 0.25
    assert linear.valid.tolist() == [[True, True, True, False, False, False]]
    for values in (linear.positions, linear.J_target, linear.J_disparity):
        assert torch.isfinite(values).all()


def test_derivatives_are_finite_for_random_motions():
    transforms = se3_exp(2 * torch.randn(50, 6, generator=generator(0), dtype=torch.float64))
    disparities = uniform(1, 50, len(RAYS))
    linear = reproject_with_jacobians(transforms, disparities, RAYS, CAMERA)
    assert linear.valid.any() and not linear.valid.all()
    assert torch.isfinite(linear.J_target).all() and torch.isfinite(linear.J_disparity).all()
