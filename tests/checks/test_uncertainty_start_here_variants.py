"""Right and wrong answers to the exercise of notebook 00."""

import numpy as np
import pytest
import torch

from minislam.checks import check_mapping_weight
from tests.helpers import assert_variants


def adjusted(beta):
    return 1.63158 * (beta.clamp_min(0.1) - 0.099) + 0.1


def cut(weight):
    return torch.where(weight < 0.1, 0.0, weight.clamp_max(5))


def as_loop(beta):
    rows = []
    for row in beta.tolist():
        values = [0.5 / (1.63158 * (max(b, 0.1) + 0.001 - 0.1) + 0.1) ** 2 for b in row]
        rows.append([min(w, 5.0) if w >= 0.1 else 0.0 for w in values])
    return rows


def with_numpy(beta):
    weight = 0.5 / (1.63158 * (np.maximum(beta.numpy(), 0.1) - 0.099) + 0.1) ** 2
    return np.minimum(weight, 5) * (weight >= 0.1)


def in_place(beta):
    beta[beta < 0.1] = 0.1
    return cut(0.5 / adjusted(beta) ** 2)


def without_floor(beta):
    return cut(0.5 / (1.63158 * (beta - 0.099) + 0.1) ** 2)


@pytest.mark.ex00_1
def test_mapping_weight():
    right = {"loop": as_loop, "numpy": with_numpy, "in place": in_place, "no floor": without_floor}
    wrong = {
        "0.1 not taken off": lambda b: cut(0.5 / (adjusted(b) + 0.163158) ** 2),
        "uncut": lambda b: (0.5 / adjusted(b) ** 2).clamp_max(5),
        "uncapped": lambda b: torch.where(adjusted(b) > 5**0.5, 0.0, 0.5 / adjusted(b) ** 2),
        "cut to 0.1": lambda b: (0.5 / adjusted(b) ** 2).clamp(0.1, 5),
        "not squared": lambda b: cut(0.5 / adjusted(b)),
        "of beta itself": lambda b: cut(0.5 / b**2),
        "only clipped": lambda b: cut(0.5 / b.clamp_min(0.1) ** 2),
        "without 0.5": lambda b: cut(1 / adjusted(b) ** 2),
        "beta adjusted": adjusted,
        "large weights cut": lambda b: (0.5 / adjusted(b) ** 2).clamp_max(0.1),
    }
    assert_variants(check_mapping_weight, right, wrong)
