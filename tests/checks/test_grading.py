"""Grading: what is wrong with an answer is said in words, whatever it returns."""

import torch

from minislam.checks import Case, check_function


def test_shapes_types_nan_and_exceptions_are_answered_in_words():
    cases = [Case((torch.ones(3),), "three ones")]

    def check(student) -> str:
        return check_function(student, lambda x: x, cases).sentence

    assert "the shape is (2,), expected (3,)" in check(lambda x: x[:2])
    assert "returns a str" in check(lambda x: "three")
    assert "element [0] is nan, expected 1" in check(lambda x: x * float("nan"))
    assert "stops with ZeroDivisionError" in check(lambda x: 1 / 0)
