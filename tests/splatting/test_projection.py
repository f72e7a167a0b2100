"""Projection of means and covariances, every step against differences and autograd."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.splatting.constants import LOW_PASS_VARIANCE, tangent_limits
from minislam.splatting.covariance import covariance_factors
from minislam.splatting.projection import (
    conics_from_factors2d,
    conics_from_factors2d_vjp,
    project_factors,
    project_factors_vjp,
    project_means,
    project_means_vjp,
    to_camera,
    to_camera_twist_vjp,
    to_camera_vjp,
)
from minislam.splatting.reference import covariances, project_covariances
from tests.helpers import assert_gradients_close, generator, numerical_gradient
from tests.splatting.scenes import random_camera, random_map, random_pose

REGIMES = {"normal": 2.5, "close": 0.1, "far": 200.0}  # mean distance in world units


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def points_and_factors(regime: str, seed: int, count: int = 4) -> tuple[Tensor, Tensor]:
    distance = REGIMES[regime]
    points = 0.25 * distance * normal(seed, 3, count)
    points[2] = distance * (0.6 + normal(seed + 1, count).abs())
    return points, 0.1 * distance * normal(seed + 2, 3, 3, count)


def assert_vjp(function: Callable, inputs: list[Tensor], gradients: list[Tensor], seed: int):
    """Check hand-written gradients of a random functional of `function`, in two ways."""
    cotangent = normal(seed + 1000, *function(*inputs).shape)
    leaves = [value.clone().requires_grad_() for value in inputs]
    (function(*leaves) * cotangent).sum().backward()
    for number, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        assert_gradients_close(gradient, leaf.grad, relative=1e-10)

        def varied(value: Tensor, number: int = number) -> Tensor:
            return (function(*inputs[:number], value, *inputs[number + 1 :]) * cotangent).sum()

        step = 1e-6 * min(1.0, float(inputs[number].abs().mean()))
        numerical = numerical_gradient(varied, inputs[number], step)
        assert_gradients_close(gradient, numerical, relative=1e-6)


def cotangent_of(function: Callable, inputs: list[Tensor], seed: int) -> Tensor:
    return normal(seed + 1000, *function(*inputs).shape)


# Known answers


def test_mean_on_the_optical_axis_lands_on_the_principal_point():
    camera = Camera(100.0, 90.0, 10.5, 7.25, 30, 20)
    point = torch.tensor([[0.0], [0.0], [3.0]], dtype=torch.float64)
    assert project_means(point, camera)[:, 0].tolist() == [10.5, 7.25]


def test_round_gaussian_on_the_axis_has_a_round_footprint():
    # sigma' = f s / z = 100 * 0.2 / 4 = 5 px, variance 25 + 0.3.
    camera = Camera(100.0, 100.0, 15.0, 10.0, 30, 20)
    point = torch.tensor([[0.0], [0.0], [4.0]], dtype=torch.float64)
    factor = 0.2 * torch.eye(3, dtype=torch.float64)[..., None]
    conic, covariance = conics_from_factors2d(project_factors(point, factor, camera))
    torch.testing.assert_close(covariance[:, 0].tolist(), [25.3, 0.0, 25.3])
    torch.testing.assert_close(conic[:, 0].tolist(), [1 / 25.3, 0.0, 1 / 25.3])


# Identities


@pytest.mark.parametrize("kind", ["ordinary", "huge", "needles", "off_screen"])
def test_factors_give_the_covariances_of_the_twin(kind: str):
    gaussians, camera, pose = random_map(kind, 30, 5), random_camera(6), random_pose(7)
    factors = covariance_factors(gaussians.quats_wxyz.T, gaussians.scales.T)
    points, camera_factors = to_camera(gaussians.means.T, factors, pose)
    conics, ours = conics_from_factors2d(project_factors(points, camera_factors, camera))
    twin = project_covariances(covariances(gaussians), points.T, pose, camera)
    torch.testing.assert_close(
        ours.T, torch.stack([twin[:, 0, 0], twin[:, 0, 1], twin[:, 1, 1]], 1)
    )
    inverse = torch.linalg.inv(twin)
    torch.testing.assert_close(conics[1], inverse[:, 0, 1], rtol=1e-8, atol=1e-12)


def test_determinant_keeps_its_digits_for_needles_in_float32():
    # A diagonal needle of 300 px: det = 0.3 * (2 * 300^2) + 0.3^2 exactly, while xx yy - xy^2
    # subtracts two numbers of 8e9 in float32.
    along = torch.tensor([[300.0, 0, 0], [300.0, 0, 0]])[..., None]
    conic, _ = conics_from_factors2d(along)
    exact = LOW_PASS_VARIANCE * 2 * 300**2 + LOW_PASS_VARIANCE**2
    expected = (300**2 + LOW_PASS_VARIANCE) / exact
    assert abs(float(conic[0, 0]) / expected - 1) < 1e-6


# Gradients


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("seed", range(7))
def test_to_camera_vjp(regime: str, seed: int):
    points, factors = points_and_factors(regime, seed)
    pose = random_pose(seed)
    for number in (0, 1):
        function = lambda x, L, n=number: to_camera(x, L, pose)[n]  # noqa: E731
        cotangent = cotangent_of(function, [points, factors], seed)
        zeros = [torch.zeros_like(points), torch.zeros_like(factors)]
        zeros[number] = cotangent
        v_means, v_factors = to_camera_vjp(pose, *zeros)
        expected = [v_means, v_factors]
        leaves = [points.clone().requires_grad_(), factors.clone().requires_grad_()]
        (function(*leaves) * cotangent).sum().backward()
        assert_gradients_close(expected[number], leaves[number].grad, relative=1e-10)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("seed", range(7))
def test_twist_vjp_is_the_derivative_of_a_left_update(regime: str, seed: int):
    points, factors = points_and_factors(regime, seed)
    pose = random_pose(seed)
    weights = normal(seed, 3, 4), normal(seed + 9, 3, 3, 4)

    def functional(twist: Tensor) -> Tensor:
        x, B = to_camera(points, factors, se3_exp(twist) @ pose)
        return (x * weights[0]).sum() + (B * weights[1]).sum()

    actual = to_camera_twist_vjp(*to_camera(points, factors, pose), *weights)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    functional(twist).backward()
    assert_gradients_close(actual, twist.grad, relative=1e-10)
    assert_gradients_close(actual, numerical_gradient(functional, twist), relative=1e-7)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("seed", range(7))
def test_project_means_vjp(regime: str, seed: int):
    points, _ = points_and_factors(regime, seed)
    camera = random_camera(seed)
    function = lambda x: project_means(x, camera)  # noqa: E731
    v_points = project_means_vjp(points, camera, cotangent_of(function, [points], seed))
    assert_vjp(function, [points], [v_points], seed)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("seed", range(7))
def test_project_factors_vjp(regime: str, seed: int):
    points, factors = points_and_factors(regime, seed)
    camera = random_camera(seed)
    function = lambda x, B: project_factors(x, B, camera)  # noqa: E731
    inputs = [points, factors]
    gradients = project_factors_vjp(
        *inputs, function(*inputs), camera, cotangent_of(function, inputs, seed)
    )
    assert_vjp(function, inputs, list(gradients), seed)


def test_limited_tangents_stop_the_gradient_across_but_not_along_the_axis():
    camera = Camera(20.0, 20.0, 7.5, 7.5, 16, 16)
    points = torch.tensor([[5.0], [0.1], [2.0]], dtype=torch.float64)  # x/z = 2.5, limit 0.52
    assert tangent_limits(camera)[1][0] == pytest.approx(1.3 * 16 / 40)
    factors = normal(3, 3, 3, 1)
    factors2d = project_factors(points, factors, camera)
    v_points, _ = project_factors_vjp(points, factors, factors2d, camera, normal(4, 2, 3, 1))
    assert v_points[0] == 0
    assert v_points[2] != 0


@pytest.mark.parametrize("size", [1.0, 0.01, 100.0])
@pytest.mark.parametrize("seed", range(7))
def test_conics_vjp(size: float, seed: int):
    factors2d = size * normal(seed, 2, 3, 4)
    function = lambda V: conics_from_factors2d(V)[0]  # noqa: E731
    gradient = conics_from_factors2d_vjp(
        factors2d, function(factors2d), cotangent_of(function, [factors2d], seed)
    )
    assert_vjp(function, [factors2d], [gradient], seed)


# The checker itself


@pytest.mark.parametrize("fault", ["sign", "percent"])
def test_a_wrong_backward_is_caught(fault: str):
    points, _ = points_and_factors("normal", 0)
    camera = random_camera(0)
    function = lambda x: project_means(x, camera)  # noqa: E731
    wrong = project_means_vjp(points, camera, cotangent_of(function, [points], 0))
    if fault == "sign":
        wrong[2] = -wrong[2]
    else:
        wrong[2] = 1.01 * wrong[2]
    with pytest.raises(AssertionError):
        assert_vjp(function, [points], [wrong], 0)
