"""The robust kernel: known values, and a weight that is the derivative of its loss."""

import pytest
import torch

from minislam.tracking.safeguards.robust import MIN_RESIDUAL, RobustKernel, weighted_median
from tests.helpers import numerical_jacobian

SQUARED = torch.tensor([0.0, 0.01, 0.3, 1.0, 4.0, 100.0], dtype=torch.float64)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 3.0])
def test_the_weight_is_the_derivative_of_the_loss(power: float):
    kernel = RobustKernel(1.3, power)
    slope = numerical_jacobian(kernel.loss, SQUARED).diagonal()
    torch.testing.assert_close(kernel.weight(SQUARED), slope, rtol=1e-6, atol=1e-8)


def test_known_values():
    nine = torch.tensor(9.0)
    assert float(RobustKernel(3.0, 1.0).weight(nine)) == pytest.approx(1 / 2)  # Cauchy
    assert float(RobustKernel(3.0).weight(nine)) == pytest.approx(1 / 4)  # Geman-McClure
    assert float(RobustKernel(3.0).loss(nine)) == pytest.approx(9 / 2)


def test_small_residuals_cost_their_square_and_a_mover_no_more_than_the_scale_allows():
    for power in (1.0, 2.0):
        small = RobustKernel(2.0, power).loss(torch.tensor(1e-6, dtype=torch.float64))
        assert float(small) == pytest.approx(1e-6, rel=1e-3)
    far, farther = RobustKernel(2.0).loss(torch.tensor([1e4, 1e8]))
    assert float(far) < float(farther) < 4.0
    far, farther = RobustKernel(2.0, 1.0).loss(torch.tensor([1e4, 1e8]))
    assert float(farther) > 2 * float(far)  # Cauchy never stops asking


def test_widening():
    assert RobustKernel(2.0).widened(4) == RobustKernel(8.0)


def test_settled_poses_ask_for_a_narrower_kernel_never_for_a_wider_one():
    kernel = RobustKernel(1.0, 1.5)
    assert kernel.narrowed(0.1).scale == pytest.approx(0.35)
    assert kernel.narrowed(0.1).power == 1.5
    assert kernel.narrowed(0.0) == kernel.narrowed(MIN_RESIDUAL) != kernel  # no flow is exact
    assert kernel.narrowed(2.0) == kernel == kernel.narrowed(None)


def test_the_weighted_median_splits_the_weight():
    values, weights = torch.tensor([3.0, 1.0, 2.0]), torch.tensor([0.1, 1.0, 0.5])
    assert weighted_median(values, weights) == 1  # of 1.6 in all, 0.8 lies below: within the first
    assert weighted_median(values, 0 * weights) is None
    assert weighted_median(values, torch.nan * weights) is None
