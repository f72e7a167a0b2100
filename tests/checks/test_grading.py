"""Grading: what is wrong with an answer is said in words, whatever it returns."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from minislam.checks import PASSED, WRONG, Case, check_function, grading, is_written
from minislam.checks.cases import normals
from minislam.checks.grading import WrongAnswer, as_numbers, difference, real_tensors, relation
from tests.helpers import unfinished

RIGHT = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 4.0]], dtype=torch.float64)


def test_shapes_types_nan_and_exceptions_are_answered_in_words():
    cases = [Case((torch.ones(3),), "three ones")]

    def check(student) -> str:
        return check_function(student, lambda x: x, cases).sentence

    assert "the shape is (2,), expected (3,)" in check(lambda x: x[:2])
    assert "returns a str" in check(lambda x: "three")
    assert "returns int too large to convert to float" in check(lambda x: 10**400)
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
    for decorator in (cache, torch.no_grad()):
        assert is_written(decorator(identity)) and not is_written(decorator(stub))


def test_a_function_that_calls_an_unwritten_one_names_it():
    def first(x):
        raise NotImplementedError  # your code here

    verdict = check_function(lambda x: first(x), double, [Case((torch.ones(3),), "ones")])
    assert repr(verdict) == "Not yet: write the body of first and run its cell again."


def double(x):
    return 2 * x


def test_the_time_of_the_reference_is_not_the_students(monkeypatch):
    clock, limits = [0.0], []

    def taking(seconds: float):
        return lambda x: clock.append(clock[-1] + seconds) or x

    def timed(function, arguments, seconds):
        limits.append(seconds)
        return function(*arguments), arguments

    monkeypatch.setattr(grading, "time", SimpleNamespace(process_time=lambda: clock[-1]))
    monkeypatch.setattr(grading, "call", timed)
    cases = [Case((torch.ones(3),), "three ones")] * 5
    assert check_function(taking(3.0), taking(60.0), cases).status == PASSED
    assert limits == [10, 7, 4, 1, 1]


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
    assert [x.dtype for x in real_tensors([0.369, torch.ones(1), np.float16(1)])] == [
        torch.float32,
        torch.float16,
    ]


def test_numbers_that_print_alike_print_their_difference():
    found = difference([0.1, 0.3690001], [0.1, 0.369], 1e-9)
    assert found == "element [1] is 1e-07 off the expected 0.369"


def test_what_is_not_an_answer_is_said():
    assert difference("3", RIGHT, 1e-6) == "it returns a str, expected a tensor"
    assert "rows of different lengths" in difference([[1.0], [1.0, 2.0]], RIGHT, 1e-6)
    assert real_tensors([np.longdouble(1), np.array(["3"]), None]) == []
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
    assert relation(torch.tensor([2.0, 0]), torch.tensor([1.0, 0]), 1e-9) == ""  # one number
    assert "NaN" in relation(RIGHT * torch.nan, RIGHT, 1e-9)
    assert relation(RIGHT + 1, RIGHT, 1e-9) == relation("3", RIGHT, 1e-9) == ""
    assert relation(RIGHT[0], RIGHT, 1e-9) == relation(0 * RIGHT, RIGHT, 1e-9) == ""
