"""Grading: what is wrong with an answer is said in words, whatever it returns."""

import torch

from minislam.checks import Case, check_function, is_written


def test_shapes_types_nan_and_exceptions_are_answered_in_words():
    cases = [Case((torch.ones(3),), "three ones")]

    def check(student) -> str:
        return check_function(student, lambda x: x, cases).sentence

    assert "the shape is (2,), expected (3,)" in check(lambda x: x[:2])
    assert "returns a str" in check(lambda x: "three")
    assert "element [0] is nan, expected 1" in check(lambda x: x * float("nan"))
    assert "stops with ZeroDivisionError" in check(lambda x: 1 / 0)


def test_a_stub_is_not_written_and_any_body_is(capsys):
    def stub(x):
        """Return x."""
        raise NotImplementedError  # your code here

    def empty(x):
        """Return x."""

    def identity(x):
        return x

    def careful(x):
        if x is None:
            raise ValueError("x is missing")
        return x
        raise NotImplementedError

    assert not is_written(stub) and not is_written(empty)
    assert capsys.readouterr().out == (
        "Write stub first, then run this cell again.\n"
        "Write empty first, then run this cell again.\n"
    )
    assert is_written(identity) and is_written(careful)
    assert capsys.readouterr().out == ""
