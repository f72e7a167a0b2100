"""The check of notebook 00: the right answer passes, the known mistake is named."""

import torch
from torch import Tensor

from minislam.checks import check_mapping_weight
from tests.helpers import assert_graded


def weight_of(beta: Tensor) -> Tensor:
    weight = 0.5 / (1.6315789 * (beta.clamp_min(0.1) - 0.099) + 0.1) ** 2
    return torch.where(weight < 0.1, 0.0, weight.clamp_max(5))


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_mapping_weight, weight_of)


def test_weights_that_are_not_cut_are_named():
    def uncut(beta: Tensor) -> Tensor:
        return (0.5 / (1.6315789 * (beta.clamp_min(0.1) - 0.099) + 0.1) ** 2).clamp_max(5)

    assert "below 0.1 must be 0" in check_mapping_weight(uncut).sentence
