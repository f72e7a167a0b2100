"""Which first depth is taken where costs are nearly equal."""

import math

import pytest
import torch

from minislam.tracking.bundle_adjustment import BundleReport, BundleState
from minislam.tracking.safeguards.first_depth import Found, most_plausible
from tests.tracking.matches import CELLS, GRID
from tests.tracking.scene import CAMERA

UNKNOWN = torch.zeros(2, CELLS)  # of two keyframes


def found_at(cost: float, log_focal: float = 0.0, slope: float = 1.0) -> Found:
    """Return a result of this cost whose disparities are so many times as large below as above."""
    ground = slope ** (GRID.pixels[:, 1] / CAMERA.height)
    state = BundleState(torch.eye(4).repeat(2, 1, 1), ground.repeat(2, 1), log_focal)
    return state, BundleReport(True, cost, cost, 1, 0.0, "")


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([found_at(90, math.log(2)), found_at(96, math.log(2))], 1),  # a doubling is worth 5 %
        ([found_at(96, math.log(2))], 0),
        ([found_at(96, math.log(0.5))], 0),
        ([found_at(104, slope=2.0)], 1),  # as is a ground, 10 % to none, 20 % to a ceiling
        ([found_at(112, slope=2.0)], 0),
        ([found_at(90, slope=0.5), found_at(104, slope=2.0)], 2),
        ([found_at(80, slope=0.5), found_at(104, slope=2.0)], 1),
        ([found_at(1, math.log(4.1)), found_at(1, math.log(0.24))], 0),  # a failed start
    ],
)
def test_of_nearly_equal_costs_the_usual_one_wins(others: list, expected: int):
    assert most_plausible(GRID, UNKNOWN, [found_at(100), *others]) == expected


def test_a_prior_says_what_is_usual():
    ceiling = 0.5 * torch.linspace(3, 1, CELLS).repeat(2, 1)
    ceiling[:, ::2] = 0  # half of it is not known
    ways = [found_at(100, slope=2.0), found_at(104, slope=0.5), found_at(110)]
    assert most_plausible(GRID, ceiling, ways) == 1
    assert most_plausible(GRID, torch.zeros_like(ceiling), ways) == 0
