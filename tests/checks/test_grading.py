"""Grading: what is wrong with an answer is said in words, whatever it returns."""

import pytest
import torch

from minislam.checks import PASSED, WRONG, Case, check_function, is_written
from minislam.checks.cases import normals
from minislam.checks.grading import WrongAnswer
from tests.helpers import unfinished


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


def double(x):
    return 2 * x


def test_strict_mode_raises(monkeypatch):
    cases = [Case((torch.ones(3),), "three ones")]
    monkeypatch.setenv("MINISLAM_STRICT", "1")
    assert check_function(double, double, cases).status == PASSED
    for wrong in (lambda x: x, lambda x: None, unfinished):
        with pytest.raises(WrongAnswer, match=r"Wrong: for three ones|Not yet: "):
            check_function(wrong, double, cases)
    monkeypatch.setenv("MINISLAM_STRICT", "0")
    assert check_function(lambda x: x, double, cases).status == WRONG


def test_a_known_mistake_is_named_also_in_single_precision():
    cases = [Case((normals(1, 4),), "four numbers")]
    hints = [(lambda x: 2 * x + 1, "One too many.")]
    verdict = check_function(lambda x: 2 * x.float() + 1, double, cases, 1e-9, hints)
    assert verdict.hint == "One too many." and verdict.sentence.endswith(". One too many.")
    verdict = check_function(lambda x: 6 * x, double, cases, 1e-9, hints)
    assert verdict.hint == "All of it is 3 times what it should be."


def test_an_answer_in_single_precision_is_compared_as_such():
    cases = [Case((100 * normals(1, 4).abs(), 100 * normals(1, 4).abs()), "equal numbers")]
    for answer in (lambda a, b: (a * 1.1 - b * 1.1).tolist(), lambda a, b: a.float() - b.float()):
        assert check_function(answer, lambda a, b: a - b, cases, 1e-9).status == PASSED
