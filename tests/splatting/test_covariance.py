"""Covariance factors from quaternions and scales, and their backward."""

import pytest
import torch

from minislam.geometry.se3 import rotation_from_quaternion
from minislam.splatting.covariance import (
    covariance_factors,
    covariance_factors_vjp,
    rotations,
    rotations_vjp,
)
from minislam.splatting.reference import covariances
from tests.helpers import assert_gradients_close, generator, numerical_gradient
from tests.splatting.scenes import random_map


def normal(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def test_quarter_turn_about_z_maps_x_to_y():
    half = 0.5**0.5
    rotation = rotations(torch.tensor([[half], [0.0], [0.0], [half]], dtype=torch.float64))[..., 0]
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(rotation, expected)


def test_rotations_agree_with_the_geometry_package():
    quats = normal(0, 4, 30)
    expected = rotation_from_quaternion(quats.T)
    torch.testing.assert_close(rotations(quats).permute(2, 0, 1), expected)


def test_factor_times_its_transpose_is_the_covariance():
    gaussians = random_map("ordinary", 20, seed=1)
    factors = covariance_factors(gaussians.quats_wxyz.T, gaussians.scales.T).permute(2, 0, 1)
    torch.testing.assert_close(factors @ factors.transpose(1, 2), covariances(gaussians))


@pytest.mark.parametrize("length", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize("seed", range(7))
def test_rotations_vjp(length: float, seed: int):
    quats, cotangent = length * normal(seed, 4, 5), normal(seed + 100, 3, 3, 5)
    actual = rotations_vjp(quats, cotangent)
    # The step of the central difference must be small against the quaternion itself.
    numerical = numerical_gradient(
        lambda q: (rotations(q) * cotangent).sum(), quats, step=1e-6 * min(length, 1.0)
    )
    assert_gradients_close(actual, numerical, relative=1e-7)
    leaf = quats.clone().requires_grad_()
    (rotations(leaf) * cotangent).sum().backward()
    assert_gradients_close(actual, leaf.grad, relative=1e-10)


@pytest.mark.parametrize("log_scale", [-1.0, -9.0, 4.0])
@pytest.mark.parametrize("seed", range(7))
def test_covariance_factors_vjp(log_scale: float, seed: int):
    quats, scales = normal(seed, 4, 5), (normal(seed + 50, 3, 5) + log_scale).exp()
    cotangent = normal(seed + 100, 3, 3, 5)
    actual = covariance_factors_vjp(quats, scales, cotangent)
    leaves = quats.clone().requires_grad_(), scales.clone().requires_grad_()
    (covariance_factors(*leaves) * cotangent).sum().backward()
    for ours, leaf in zip(actual, leaves, strict=True):
        assert_gradients_close(ours, leaf.grad, relative=1e-10)
    numerical = numerical_gradient(
        lambda q: (covariance_factors(q, scales) * cotangent).sum(), quats
    )
    assert_gradients_close(actual[0], numerical, relative=1e-7)


def test_length_of_a_quaternion_has_no_gradient():
    quats = normal(3, 4, 6)
    radial = (quats * rotations_vjp(quats, normal(4, 3, 3, 6))).sum(0)
    assert radial.abs().max() < 1e-14
