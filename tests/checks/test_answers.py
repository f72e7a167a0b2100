"""Answers in any form are numbers; what is wrong with them is said in words."""

import numpy as np
import pytest
import torch

from minislam.checks.answers import as_numbers, difference, is_single, relation

RIGHT = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 4.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    "answer",
    [
        RIGHT.float(),
        RIGHT.tolist(),
        RIGHT.numpy(),
        list(RIGHT),
        tuple(RIGHT.numpy()),
        RIGHT.numpy()[::-1, ::-1][::-1, ::-1],
        RIGHT.clone().requires_grad_() * 1,
        [[np.float64(0.1), torch.tensor(0.2).double(), 0.3], RIGHT[1]],
    ],
)
def test_numbers_in_any_form_are_compared(answer):
    assert difference(answer, RIGHT, 1e-6) == ""
    assert as_numbers(answer).dtype == torch.float64


def test_one_number_is_one_number_in_any_shape():
    for answer in (0.369, np.float64(0.369), [0.369], RIGHT.new_tensor([[0.369]])):
        assert difference(answer, 0.369, 1e-9) == "", answer
    assert not is_single(0.369) and is_single([1.0, torch.ones(1)]) and is_single(np.float32(1))


def test_numbers_that_print_alike_print_their_difference():
    found = difference([0.1, 0.3690001], [0.1, 0.369], 1e-9)
    assert found == "element [1] is 1e-07 off the expected 0.369"


def test_what_is_not_an_answer_is_said():
    assert difference("3", RIGHT, 1e-6) == "it returns a str, expected a tensor"
    assert "rows of different lengths" in difference([[1.0], [1.0, 2.0]], RIGHT, 1e-6)
    assert "returns complex numbers, " in difference(RIGHT + 0j, RIGHT, 1e-6)
    assert difference(RIGHT[0], RIGHT, 1e-6) == "the shape is (3,), expected (2, 3)"
    pair = RIGHT[0], RIGHT[1]
    assert (
        difference(RIGHT[0], pair, 1e-6, ("xi", "delta"))
        == "it returns 1 value, expected 2: xi, delta"
    )
    assert difference((*pair, 1), pair, 1e-6) == "it returns 3 values, expected 2"
    found = difference((RIGHT[0], RIGHT[0]), pair, 1e-6, ("xi", "delta"))
    assert found == "in delta element [0] is 0.1, expected 1"


def test_an_expected_zero_may_be_rounded():
    zero = torch.zeros(2)
    assert difference(zero + 1e-13, zero, 1e-9) == ""
    assert difference(zero + 1e-10, zero, 1e-9)


def test_simple_relations_are_named():
    assert "transpose" in relation(RIGHT.T, RIGHT, 1e-9)
    assert "reversed" in relation(RIGHT.flip(0), RIGHT, 1e-9)
    assert "sign" in relation(-RIGHT, RIGHT, 1e-9)
    assert "2 times" in relation(2 * RIGHT, RIGHT, 1e-9)
    assert "NaN" in relation(RIGHT * torch.nan, RIGHT, 1e-9)
    assert relation(RIGHT + 1, RIGHT, 1e-9) == relation("3", RIGHT, 1e-9) == ""
    assert relation(RIGHT[0], RIGHT, 1e-9) == relation(0 * RIGHT, RIGHT, 1e-9) == ""
