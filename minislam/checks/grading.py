"""Grade an answer against the package, case by case, up to the first wrong number."""

import dis
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from minislam.checks.answers import SMALLEST, difference, is_single, largest, relation
from minislam.checks.calls import Stopped, call
from minislam.checks.cases import Case

PASSED, NOT_YET, WRONG = "passed", "not yet", "wrong"
SECONDS = 10.0  # of the student's function, all cases together

Function = Callable[..., Any]  # answers with numbers in any form, or with a tuple of such
Hints = Sequence[tuple[Any, str]]  # (known mistake, the sentence that explains it)


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
    hints: Hints = (),
    flaws: dict[str, str] | None = None,  # those that the reference makes where asked by `flaw=`
    returns: tuple[str, ...] = (),  # the names of the values, where there are several
) -> Verdict:
    """Compare a student's function with the reference on all cases, up to the first difference.

    MINISLAM_STRICT=1 raises WrongAnswer where the answer has not passed, so that nbmake and
    nbgrader see it.
    """
    known = [(partial(reference, flaw=flaw), hint) for flaw, hint in (flaws or {}).items()]
    verdict = _graded(student, reference, cases, tolerance, [*known, *hints], returns)
    if verdict.status != PASSED and os.environ.get("MINISLAM_STRICT", "0") not in ("", "0"):
        raise WrongAnswer(repr(verdict))
    return verdict


def _graded(
    student: Function,
    reference: Function,
    cases: list[Case],
    tolerance: float,
    hints: Hints,
    returns: tuple[str, ...],
) -> Verdict:
    seconds = SECONDS
    for case in cases:
        begin = time.process_time()
        try:
            answer, given = call(student, case.arguments, seconds)
        except NotImplementedError:
            return Verdict(NOT_YET, "write the body of the function and run both cells again.")
        except Stopped as stop:
            return Verdict(WRONG, f"for {case.description} it {stop}.")
        if answer is None:
            return Verdict(NOT_YET, f"for {case.description} the function returns nothing.")
        expected, smallest, allowed = reference(*case.arguments), SMALLEST, tolerance
        if is_single((answer, given)):  # rounding errors are those of the largest number
            allowed, smallest = max(tolerance, 1e-5), max(1.0, largest(given))
        if found := difference(answer, expected, allowed, returns, smallest):
            smallest = max(smallest, largest(expected))
            others = ((mistake(*case.arguments), hint) for mistake, hint in hints)
            known = (h for x, h in others if not difference(answer, x, allowed, (), smallest))
            hint = next(known, "") or relation(answer, expected, allowed)
            return Verdict(WRONG, f"for {case.description} {found}. {hint}".rstrip(), hint)
        seconds = max(seconds - (time.process_time() - begin), 1.0)
    return Verdict(PASSED, f"{len(cases)} of {len(cases)} cases agree with the package.")


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
