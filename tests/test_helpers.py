"""The checkers are checked: a derivative with a flipped sign or one percent off must not pass."""

import os
import subprocess
import sys

import pytest
import torch

from minislam.geometry import Camera, se3_inverse
from tests.conftest import ROOT
from tests.helpers import (
    assert_gradients_close,
    generator,
    numerical_gradient,
    numerical_jacobian,
    random_transforms,
)

CAMERA = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)
POINT = torch.tensor([0.4, -0.3, 2.0], dtype=torch.float64)


def projection_vjp(point: torch.Tensor, v_uv: torch.Tensor) -> torch.Tensor:
    """Return dL/d(point) of a projection: the correct backward pass that is then damaged."""
    return CAMERA.project_jacobian(point).T @ v_uv


def expected_gradient(v_uv: torch.Tensor) -> torch.Tensor:
    return numerical_gradient(lambda point: (CAMERA.project(point) * v_uv).sum(), POINT)


V_UV = torch.tensor([0.7, -1.3], dtype=torch.float64)


def test_a_correct_vjp_passes():
    assert_gradients_close(projection_vjp(POINT, V_UV), expected_gradient(V_UV))


@pytest.mark.parametrize("element", [0, 1, 2])
def test_a_vjp_with_one_flipped_sign_is_caught(element: int):
    wrong = projection_vjp(POINT, V_UV)
    wrong[element] = -wrong[element]
    with pytest.raises(AssertionError):
        assert_gradients_close(wrong, expected_gradient(V_UV))


@pytest.mark.parametrize("element", [0, 1, 2])
def test_a_vjp_with_one_percent_error_in_one_element_is_caught(element: int):
    wrong = projection_vjp(POINT, V_UV)
    wrong[element] *= 1.01
    with pytest.raises(AssertionError):
        assert_gradients_close(wrong, expected_gradient(V_UV))


def test_a_common_factor_of_one_percent_is_caught_although_the_direction_is_right():
    with pytest.raises(AssertionError, match=r"relative L2|element"):
        assert_gradients_close(1.01 * projection_vjp(POINT, V_UV), expected_gradient(V_UV))


def test_a_small_wrong_element_among_many_large_ones_is_caught():
    expected = 1e3 * torch.randn(1000, generator=generator(0), dtype=torch.float64)
    expected[7] = 1.0
    wrong = expected.clone()
    wrong[7] = -1.0
    with pytest.raises(AssertionError):
        assert_gradients_close(wrong, expected)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_is_caught(value: float):
    wrong = torch.ones(3, dtype=torch.float64)
    wrong[1] = value
    with pytest.raises(AssertionError, match="not finite"):
        assert_gradients_close(wrong, torch.ones(3, dtype=torch.float64))


def test_a_gradient_that_is_zero_where_it_must_not_be_is_caught():
    with pytest.raises(AssertionError):
        assert_gradients_close(torch.zeros(3, dtype=torch.float64), expected_gradient(V_UV))


def test_another_shape_is_caught_even_if_it_would_broadcast():
    with pytest.raises(AssertionError):
        assert_gradients_close(torch.ones(1, 3), torch.ones(3))


def test_numerical_jacobian_of_known_functions():
    # f(x, y) = (x y, x^2) has the Jacobian [[y, x], [2 x, 0]].
    def function(p: torch.Tensor) -> torch.Tensor:
        return torch.stack([p[0] * p[1], p[0] ** 2])

    jacobian = numerical_jacobian(function, torch.tensor([3.0, -2.0], dtype=torch.float64))
    expected = torch.tensor([[-2.0, 3.0], [6.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(jacobian, expected, atol=1e-8, rtol=1e-8)
    matrix = torch.randn(4, 3, generator=generator(1), dtype=torch.float64)
    shape = numerical_jacobian(lambda x: matrix @ x, torch.zeros(3, 5)).shape
    assert shape == (4, 5, 3, 5)


@pytest.mark.parametrize("regime", ["normal", "tiny", "half_turn"])
def test_random_transforms_are_rigid_repeatable_and_of_their_regime(regime: str):
    transforms = random_transforms(30, regime, seed=4)
    assert torch.equal(transforms, random_transforms(30, regime, seed=4))
    product = transforms @ se3_inverse(transforms)
    assert (product - torch.eye(4, dtype=torch.float64)).abs().max() < 1e-12
    trace = transforms[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.acos(((trace - 1) / 2).clamp(-1, 1))
    low, high = {"normal": (0, 3.0), "tiny": (0, 1e-6), "half_turn": (3.14, 3.15)}[regime]
    assert angle.min() >= low and angle.max() <= high


def test_the_settings_of_the_tests_hold_before_a_folder_imports_torch():
    # With tests/runs on the command line its conftest.py, and so torch, comes before any hook.
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    code = "import tests.conftest, torch; print(torch.get_num_threads())"
    command = [sys.executable, "-c", code]
    assert subprocess.check_output(command, env=environment, cwd=ROOT).strip() == b"1"
