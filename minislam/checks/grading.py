"""Grade an answer against the package, case by case, up to the first wrong number."""

import dis
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import Camera

PASSED, NOT_YET, WRONG = "passed", "not yet", "wrong"
# No two of its numbers are equal, so that an exchange of axes is noticed.
CAMERA = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)

Function = Callable[..., Any]  # answers with a tensor, or what becomes one
Hints = list[tuple[Function, str]]  # (known mistake, the sentence that explains it)


@dataclass(frozen=True)
class Verdict:
    """What a check found; a notebook shows the sentence."""

    status: str  # PASSED, NOT_YET or WRONG
    sentence: str

    def __repr__(self) -> str:
        return f"{self.status.capitalize()}: {self.sentence}"


@dataclass(frozen=True)
class Case:
    """One input of a check, and what it stands for."""

    arguments: tuple[Any, ...]
    description: str  # completes "for ..."


def doubles(*values: Any) -> Tensor:
    """Return numbers, or lists of numbers, as a float64 tensor."""
    return torch.tensor(values, dtype=torch.float64)


def check_function(
    student: Function,
    reference: Function,
    cases: list[Case],
    tolerance: float = 1e-6,  # relative to the largest expected number, at least 1
    hints: Hints | None = None,
) -> Verdict:
    """Compare a student's function with the reference on all cases, up to the first difference."""
    for case in cases:
        expected = torch.as_tensor(reference(*case.arguments))
        try:
            answer = student(*case.arguments)
        except NotImplementedError:
            return Verdict(NOT_YET, "write the body of the function and run both cells again.")
        except Exception as error:  # any mistake of the student's is an answer, not a crash
            message = f"for {case.description} it stops with {type(error).__name__}: {error}."
            return Verdict(WRONG, message)
        if answer is None:
            return Verdict(NOT_YET, f"for {case.description} the function returns nothing.")
        found = _difference(answer, expected, tolerance)
        if found:
            hint = _hint(answer, case, hints or [], tolerance)
            return Verdict(WRONG, f"for {case.description} {found}.{hint}")
    return Verdict(PASSED, f"{len(cases)} of {len(cases)} cases agree with the package.")


def _difference(answer: Any, expected: Tensor, tolerance: float) -> str:
    """Return "" if the answer is right, else what is wrong with it."""
    try:
        answer = torch.as_tensor(answer).to(expected.dtype)
    except (TypeError, ValueError, RuntimeError):
        return f"it returns a {type(answer).__name__}, expected a tensor"
    if answer.shape != expected.shape:
        return f"the shape is {tuple(answer.shape)}, expected {tuple(expected.shape)}"
    allowed = tolerance * max(1.0, float(expected.abs().max()))
    wrong = ~((answer - expected).abs() <= allowed)  # the negation also catches NaN
    if not wrong.any():
        return ""
    index = tuple(wrong.nonzero()[0].tolist())
    where = f"element {list(index)}" if index else "the value"
    return f"{where} is {float(answer[index]):.6g}, expected {float(expected[index]):.6g}"


def _hint(answer: Any, case: Case, hints: Hints, tolerance: float) -> str:
    """Return the hint whose known mistake gives the student's answer, or ""."""
    for mistake, hint in hints:
        if not _difference(answer, torch.as_tensor(mistake(*case.arguments)), tolerance):
            return f" {hint}"
    return ""


def is_written(function: Function) -> bool:
    """Say whether an exercise's function has a body; where not, print what to do.

    In a notebook, the cell that uses the function begins with `if checks.is_written(NAME):`.
    """
    steps = list(dis.get_instructions(function))
    is_stub = any(step.argval == "NotImplementedError" for step in steps)
    is_empty = {step.argval for step in steps if step.opname != "RESUME"} <= {None, ""}
    if is_stub or is_empty:
        sys.stdout.write(f"Write {function.__name__} first, then run this cell again.\n")
    return not (is_stub or is_empty)
