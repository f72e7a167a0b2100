"""SO(3) and SE(3): the theorems they must obey, in every regime of angles."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from minislam.geometry import (
    se3_adjoint,
    se3_exp,
    se3_interpolate,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    se3_normalised,
    so3_exp,
    so3_log,
    transform_points,
)
from minislam.geometry.se3 import (
    hat,
    quaternion_from_rotation,
    quaternion_product,
    rotation_from_quaternion,
    so3_left_jacobian,
)
from tests.helpers import (
    assert_gradients_close,
    generator,
    numerical_gradient,
    numerical_jacobian,
    random_transforms,
)

REGIMES = ["normal", "tiny", "half_turn"]
# Both sides of every switch between a series and a closed form, and the ends of the range.
ANGLES = [0.0, 1e-12, 1e-9, 1e-5, 0.0199, 0.0201, 0.299, 0.301, 1.0, 3.0]
ANGLES_AT_PI = [math.pi - 1e-6, math.pi - 1e-9, math.pi]


def tangents(angle: float, count: int = 20, seed: int = 0) -> torch.Tensor:
    """Return tangent vectors (count, 6) of one rotation angle and random rest."""
    xi = torch.randn(count, 6, generator=generator(seed), dtype=torch.float64)
    xi[:, 3:] *= angle / xi[:, 3:].norm(dim=-1, keepdim=True)
    return xi


def hat_se3(xi: torch.Tensor) -> torch.Tensor:
    """Return the 4x4 matrix whose matrix exponential is the transform."""
    matrix = torch.zeros(*xi.shape[:-1], 4, 4, dtype=xi.dtype)
    matrix[..., :3, :3] = hat(xi[..., 3:])
    matrix[..., :3, 3] = xi[..., :3]
    return matrix


def distance(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).abs().max())


# Known answers


def test_hat_is_the_cross_product():
    a, b = torch.randn(2, 10, 3, generator=generator(0), dtype=torch.float64)
    assert distance((hat(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b)) < 1e-15


def test_a_quarter_turn_about_z_takes_x_to_y():
    rotation = so3_exp(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64))
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    assert distance(rotation, expected) < 1e-15


def test_a_screw_of_half_a_turn_about_z():
    # rho = (1, 0, 1) while turning by pi about z. V = [[sin t, cos t - 1], [1 - cos t, sin t]] / t
    # in the plane, so x' = sin(pi) / pi = 0, y' = (1 - cos pi) / pi = 2 / pi, z' = 1.
    transform = se3_exp(torch.tensor([1, 0, 1, 0, 0, math.pi], dtype=torch.float64))
    expected = torch.tensor([0, 2 / math.pi, 1], dtype=torch.float64)
    assert distance(transform[:3, 3], expected) < 1e-15


@pytest.mark.parametrize("angle", ANGLES + ANGLES_AT_PI)
def test_exp_is_the_matrix_exponential(angle: float):
    xi = tangents(angle, 5)
    expected = torch.from_numpy(np.stack([expm(m) for m in hat_se3(xi).numpy()]))
    assert distance(se3_exp(xi), expected) < 5e-13


def test_rotations_agree_with_scipy():
    phi = tangents(2.5)[:, 3:]
    expected = Rotation.from_rotvec(phi.numpy())
    assert distance(so3_exp(phi), torch.from_numpy(expected.as_matrix())) < 1e-14
    quats_xyzw = torch.from_numpy(expected.as_quat(canonical=True))
    ours = quaternion_from_rotation(so3_exp(phi))
    ours = torch.where(ours[:, :1] < 0, -ours, ours)
    assert distance(ours, quats_xyzw[:, [3, 0, 1, 2]]) < 1e-14


# Identities


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle: float):
    xi = tangents(angle)
    assert distance(se3_log(se3_exp(xi)), xi) < 1e-12


@pytest.mark.parametrize("angle", ANGLES_AT_PI)
def test_exp_undoes_log_near_half_a_turn(angle: float):
    # At pi the axis is defined up to its sign, so the transforms are compared.
    transforms = se3_exp(tangents(angle))
    xi = se3_log(transforms)
    assert distance(se3_exp(xi), transforms) < 1e-6
    assert distance(xi[:, 3:].norm(dim=-1), torch.full((20,), angle, dtype=torch.float64)) < 1e-6


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0.6, -0.8, 0]])
def test_log_of_an_exact_half_turn_has_length_pi_and_the_right_axis(axis: list[float]):
    n = torch.tensor(axis, dtype=torch.float64)
    rotation = 2 * torch.outer(n, n) - torch.eye(3, dtype=torch.float64)
    phi = so3_log(rotation)
    assert abs(float(phi.norm()) - math.pi) < 1e-12
    assert distance(torch.linalg.cross(phi, n), torch.zeros(3, dtype=torch.float64)) < 1e-12


@pytest.mark.parametrize("regime", REGIMES)
def test_group_axioms(regime: str):
    a, b, c = (random_transforms(20, regime, seed) for seed in (1, 2, 3))
    identity = torch.eye(4, dtype=torch.float64).expand(20, 4, 4)
    assert distance(a @ se3_inverse(a), identity) < 1e-12
    assert distance(se3_inverse(a) @ a, identity) < 1e-12
    assert distance(se3_inverse(a @ b), se3_inverse(b) @ se3_inverse(a)) < 1e-12
    assert distance((a @ b) @ c, a @ (b @ c)) < 1e-12
    rotation = a[:, :3, :3]
    assert distance(rotation @ rotation.transpose(-1, -2), identity[:, :3, :3]) < 1e-12
    assert distance(torch.linalg.det(rotation), torch.ones(20, dtype=torch.float64)) < 1e-12


def test_a_motion_continued_many_times_stays_rigid():
    # With last @ inverse(before) @ last the round-off would grow 2.4 times at every step.
    before, last = random_transforms(2, "normal", 7)
    identity = torch.eye(3, dtype=torch.float64)
    for _ in range(200):
        before, last = last, se3_interpolate(before, last, 2.0)
        assert distance(last[:3, :3] @ last[:3, :3].T, identity) < 1e-14


def test_normalising_repairs_a_rotation_and_leaves_a_good_one():
    transforms = random_transforms(20, "normal", 8)
    assert distance(se3_normalised(transforms), transforms) < 1e-14
    stretched = transforms.clone()
    stretched[:, :3, :3] *= 1.01
    repaired = se3_normalised(stretched)
    assert distance(repaired @ se3_inverse(repaired), torch.eye(4).expand(20, 4, 4)) < 1e-12


@pytest.mark.parametrize("regime", REGIMES)
def test_adjoint_moves_a_tangent_through_a_transform(regime: str):
    transforms, xi = random_transforms(20, regime, 4), tangents(0.7, seed=5)
    left = transforms @ se3_exp(xi) @ se3_inverse(transforms)
    right = se3_exp((se3_adjoint(transforms) @ xi[..., None]).squeeze(-1))
    assert distance(left, right) < 1e-11  # |t| of a few units multiplies the round-off
    other = random_transforms(20, regime, 6)
    product = se3_adjoint(transforms) @ se3_adjoint(other)
    assert distance(se3_adjoint(transforms @ other), product) < 1e-12


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.0199, 0.0201, 0.2999, 0.3001, 1.5, 3.1])
def test_left_jacobian_is_the_series_of_ad(angle: float):
    # J = sum_n ad(xi)^n / (n + 1)!, with ad(xi) = [[hat(phi), hat(rho)], [0, hat(phi)]].
    xi = tangents(angle)
    ad = torch.zeros(20, 6, 6, dtype=torch.float64)
    ad[:, :3, :3] = ad[:, 3:, 3:] = hat(xi[:, 3:])
    ad[:, :3, 3:] = hat(xi[:, :3])
    term = torch.eye(6, dtype=torch.float64).expand(20, 6, 6)
    series = term
    for n in range(1, 40):
        term = term @ ad / (n + 1)
        series = series + term
    assert distance(se3_left_jacobian(xi), series) < 1e-11


@pytest.mark.parametrize("regime", REGIMES)
def test_quaternions_and_rotations_are_inverse_to_each_other(regime: str):
    rotation = random_transforms(50, regime, 7)[:, :3, :3]
    quats_wxyz = quaternion_from_rotation(rotation)
    assert distance(rotation_from_quaternion(quats_wxyz), rotation) < 1e-12
    assert distance(rotation_from_quaternion(-3 * quats_wxyz), rotation) < 1e-12


def test_transform_points_equals_the_homogeneous_product():
    transforms = random_transforms(4, "normal", 8)
    points = torch.randn(4, 7, 3, generator=generator(9), dtype=torch.float64)
    homogeneous = torch.cat([points, torch.ones(4, 7, 1, dtype=torch.float64)], -1)
    expected = (transforms[:, None] @ homogeneous[..., None])[..., :3, 0]
    assert distance(transform_points(transforms, points), expected) < 1e-13


# Gradients


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.0199, 0.0201, 1.0, 3.0])
def test_left_jacobian_is_the_derivative_of_exp(angle: float):
    # exp(xi + d) exp(xi)^-1 = exp(J d + ...), so J = d log(...) / d d at d = 0.
    for xi in tangents(angle, 3):
        back = se3_inverse(se3_exp(xi))

        def moved(offset: torch.Tensor, xi=xi, back=back) -> torch.Tensor:
            return se3_log(se3_exp(xi + offset) @ back)

        numeric = numerical_jacobian(moved, torch.zeros(6, dtype=torch.float64))
        by_autograd = torch.autograd.functional.jacobian(moved, torch.zeros(6, dtype=torch.float64))
        assert_gradients_close(se3_left_jacobian(xi), numeric, relative=1e-7, absolute=1e-8)
        assert_gradients_close(se3_left_jacobian(xi), by_autograd, relative=1e-8, absolute=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0199, 0.0201, 1.0, 3.0])
@pytest.mark.parametrize("name", ["exp", "log", "left_jacobian"])
def test_autograd_agrees_with_finite_differences(name: str, angle: float):
    weight = torch.randn(6, 6, generator=generator(10), dtype=torch.float64)
    functions = {
        "exp": lambda x: (weight[:4, :4] * se3_exp(x)).sum(),
        "log": lambda x: (weight[0] * se3_log(se3_exp(x))).sum(),
        "left_jacobian": lambda x: (weight[:3, :3] * so3_left_jacobian(x[3:])).sum(),
    }
    xi = tangents(angle, 1)[0].requires_grad_()
    functions[name](xi).backward()
    numeric = numerical_gradient(functions[name], xi)
    assert_gradients_close(xi.grad, numeric, relative=1e-7, absolute=1e-8)


# Degenerate input


def test_the_identity_has_finite_gradients_and_log_zero():
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert distance(se3_log(torch.eye(4, dtype=torch.float64)), torch.zeros(6)) == 0
    (gradient,) = torch.autograd.grad(se3_exp(xi).sum(), xi)
    # d(sum of entries) = sum(rho) + sum(hat(phi)) = sum(rho) + 0.
    expected = torch.tensor([1, 1, 1, 0, 0, 0], dtype=torch.float64)
    assert distance(gradient, expected) < 1e-15
    (gradient,) = torch.autograd.grad(se3_log(se3_exp(xi)).sum(), xi)
    assert distance(gradient, torch.ones(6, dtype=torch.float64)) < 1e-12


@pytest.mark.parametrize("angle", ANGLES + ANGLES_AT_PI)
def test_float32_keeps_float32_accuracy(angle: float):
    xi = tangents(angle)
    single = se3_exp(xi.float())
    assert single.dtype == torch.float32
    assert distance(single.double(), se3_exp(xi)) < 5e-6
    assert torch.isfinite(se3_log(single)).all()


def test_empty_batches_stay_empty():
    assert se3_exp(torch.zeros(0, 6)).shape == (0, 4, 4)
    assert se3_log(torch.zeros(0, 4, 4)).shape == (0, 6)


def test_quaternion_product_is_the_product_of_rotations():
    a, b = torch.randn(2, 5, 4, generator=generator(1), dtype=torch.float64)
    product = rotation_from_quaternion(quaternion_product(a, b))
    torch.testing.assert_close(product, rotation_from_quaternion(a) @ rotation_from_quaternion(b))
