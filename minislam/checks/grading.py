"""Grade an answer against the package, case by case, up to the first wrong number."""

import dis
import inspect
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from minislam.checks.calls import Stopped, call
from minislam.checks.cases import Case

PASSED, NOT_YET, WRONG = "passed", "not yet", "wrong"
SINGLE = (torch.float32, torch.float16, torch.bfloat16)
ARRAYS = (np.float64, np.float32, np.float16)  # torch knows no other real numbers
NO_NUMBERS = (TypeError, ValueError, OverflowError)  # of `as_numbers`
SMALLEST = 1e-3  # an expected number below this counts as this: it may be a rounded zero
SECONDS = 10.0  # of the student's function, all cases together; each case has at least 1

Function = Callable[..., Any]  # answers with numbers in any form, or with a tuple of such


@dataclass(frozen=True)
class Verdict:
    """What a check found; a notebook shows the sentence."""

    status: str  # PASSED, NOT_YET or WRONG
    sentence: str
    hint: str = ""  # the end of the sentence where the mistake is a known one

    def __repr__(self) -> str:
        return f"{self.status.capitalize()}: {self.sentence}"


class WrongAnswer(AssertionError):
    """An exercise that has not passed, where MINISLAM_STRICT is set."""


def check_function(
    student: Function,
    reference: Function,
    cases: list[Case],
    tolerance: float = 1e-6,  # relative to the largest expected number; 1e-5 in float32
    mistakes: Sequence[tuple[Any, str]] = (),  # a function, or a `flaw` of the reference; a hint
    returns: tuple[str, ...] = (),  # the names of the values, where there are several
    outcome: Callable[..., Any] | None = None,  # of (function, *inputs), to be compared instead
) -> Verdict:
    """Compare a student's function with the reference on all cases, up to the first difference.

    MINISLAM_STRICT=1 raises WrongAnswer where it has not passed, so that nbmake and nbgrader see.
    """

    def observed(function: Function) -> Function:
        return partial(outcome, function) if outcome else function

    student, right, seconds = observed(student), observed(reference), SECONDS
    for case in cases:
        begin = time.process_time()
        try:
            answer, given = call(student, case.arguments, seconds)
        except NotImplementedError as stub:
            name = traceback.extract_tb(stub.__traceback__)[-1].name  # may be one that it calls
            return _verdict(NOT_YET, f"write the body of {name} and run its cell again.")
        except Stopped as stop:
            return _verdict(WRONG, f"for {case.description} it {stop}.")
        seconds = max(seconds - (time.process_time() - begin), 1.0)
        if answer is None:
            return _verdict(NOT_YET, f"for {case.description} the function returns nothing.")
        expected, smallest, allowed = right(*case.arguments), SMALLEST, tolerance
        if any(x.dtype in SINGLE for x in real_tensors((answer, given))):
            # Rounding errors are those of the largest number.
            allowed, smallest = max(tolerance, 1e-5), max(1.0, largest(given))
        if found := difference(answer, expected, allowed, returns, smallest):
            smallest = max(smallest, largest(expected))
            others = (
                (observed(m if callable(m) else partial(reference, flaw=m))(*case.arguments), hint)
                for m, hint in mistakes
            )
            named = (h for x, h in others if not difference(answer, x, allowed, (), smallest))
            hint = next(named, "") or relation(answer, expected, allowed)
            return _verdict(WRONG, f"for {case.description} {found}. {hint}".rstrip(), hint)
    return _verdict(PASSED, f"{len(cases)} of {len(cases)} cases agree with the package.")


def _verdict(status: str, sentence: str, hint: str = "") -> Verdict:
    verdict = Verdict(status, sentence, hint)
    if status != PASSED and os.environ.get("MINISLAM_STRICT", "0") not in ("", "0"):
        raise WrongAnswer(repr(verdict)) from None
    return verdict


def is_written(function: Function) -> bool:
    """Say whether an exercise's function has a body; where not, print what to do."""
    steps = list(dis.get_instructions(inspect.unwrap(function)))
    is_stub = any(step.argval == "NotImplementedError" for step in steps)
    is_empty = {step.argval for step in steps if step.opname != "RESUME"} <= {None, ""}
    if is_stub or is_empty:
        sys.stdout.write(f"Write {function.__name__} first, then run this cell again.\n")
    return not (is_stub or is_empty)


def real_tensors(value: Any) -> list[Tensor]:
    """Return the tensors and arrays of real numbers in a value, or in lists of values."""
    if isinstance(value, list | tuple):
        return [tensor for part in value for tensor in real_tensors(part)]
    if isinstance(value, np.ndarray | np.generic) and value.dtype in ARRAYS:
        value = torch.from_numpy(np.array(value))
    return [value] if isinstance(value, Tensor) and value.is_floating_point() else []


def largest(value: Any) -> float:
    """Return the largest absolute value of all real tensors, 0 if there are none."""
    return max((float(x.abs().max()) for x in real_tensors(value) if x.numel()), default=0.0)


def as_numbers(answer: Any) -> Tensor:
    """Return numbers in float64. Raises NO_NUMBERS: not a number, ragged, too large."""
    if isinstance(answer, np.ndarray | np.generic):
        answer = torch.from_numpy(np.array(answer))  # a copy: also of what runs backwards
    if isinstance(answer, Tensor):
        if answer.is_complex():
            raise TypeError("complex numbers")
        return answer.detach().cpu().double()
    if isinstance(answer, list | tuple):
        parts = [as_numbers(part) for part in answer]
        if len({part.shape for part in parts}) > 1:
            raise ValueError("rows of different lengths")
        return torch.stack(parts) if parts else torch.zeros(0, dtype=torch.float64)
    if not isinstance(answer, bool | int | float):
        raise TypeError(f"a {type(answer).__name__}")
    return torch.tensor(answer, dtype=torch.float64)


def difference(
    answer: Any,
    expected: Any,
    tolerance: float,  # relative to the largest expected number, or to `smallest`
    names: tuple[str, ...] = (),  # of the parts, where a tuple is expected
    smallest: float = SMALLEST,
) -> str:
    """Return "" if the answer is right, else what is wrong with it."""
    if isinstance(expected, tuple):
        count = len(answer) if isinstance(answer, list | tuple) else 1
        if count != len(expected):
            wanted = f"{len(expected)}: {', '.join(names)}" if names else len(expected)
            return f"it returns {count} value{'s' * (count != 1)}, expected {wanted}"
        for place, (part, right) in enumerate(zip(answer, expected, strict=True)):
            if found := difference(part, right, tolerance, smallest=smallest):
                return f"in {names[place] if names else f'value {place + 1}'} {found}"
        return ""
    try:
        numbers, right = as_numbers(answer), as_numbers(expected)
    except NO_NUMBERS as error:
        return f"it returns {error}, expected a tensor"
    if numbers.shape != right.shape:
        if numbers.numel() != 1 or right.numel() != 1:
            return f"the shape is {tuple(numbers.shape)}, expected {tuple(right.shape)}"
        numbers = numbers.view(right.shape)  # (1,) for () and the like
    wrong = ~((numbers - right).abs() <= tolerance * max(largest(right), smallest))  # also of NaN
    if not wrong.any():
        return ""
    index = tuple(wrong.nonzero()[0].tolist())
    where = f"element {list(index)}" if index else "the value"
    found, wanted = f"{numbers[index]:.6g}", f"{right[index]:.6g}"
    if found == wanted:
        return f"{where} is {abs(numbers[index] - right[index]):.2g} off the expected {wanted}"
    return f"{where} is {found}, expected {wanted}"


def relation(answer: Any, expected: Any, tolerance: float) -> str:
    """Return a sentence where one simple change makes the answer right, else ""."""
    try:
        numbers, right = as_numbers(answer), as_numbers(expected)
    except NO_NUMBERS:
        return ""
    if not numbers.isfinite().all():
        return "A number is NaN or infinite: what is divided by zero, or has no root?"
    if right.ndim > 1 < numbers.ndim and not difference(numbers.mT, right, tolerance):
        return "This is the transpose."
    if numbers.shape != right.shape or not right.numel():
        return ""
    if right.ndim and not difference(numbers.flip(0), right, tolerance):
        return "The order is reversed."
    factor = float((numbers * right).sum() / right.square().sum().clamp_min(1e-300))
    if abs(factor) < 1e-6 or difference(numbers / factor, right, tolerance):
        return ""
    if abs(factor + 1) < 1e-5:
        return "The sign is the other one."
    if int((right != 0).sum()) < 2:
        return ""  # one number is always a multiple of another
    return f"All of it is {factor:.4g} times what it should be."
