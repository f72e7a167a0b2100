"""Judge the parts of a submission with the installed checks, in a process of its own.

`python -m minislam.checks.judge FOLDER` reads FOLDER/job.json and appends one line to
FOLDER/verdicts.txt before and after each exercise, so that `minislam grade` knows where a student's
code ended the program. The code shares the process with the checks: replaced functions of the
package are noticed, but whoever sets out to deceive Python itself will, so read what surprises you.
"""

from __future__ import annotations

import json
import runpy
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from minislam import checks
from minislam.checks.calls import Stopped, call
from minislam.checks.grading import SECONDS, WRONG, Verdict
from minislam.checks.points import EXERCISES, MAY_CALL, MAY_NOT_CALL, Exercise
from minislam.checks.submission import SUBMITTED, Part, parts_of

REFUSED = "refused"
PACKAGE = str(Path(checks.__file__).parents[1])
BY_KEY = {exercise.key: exercise for exercise in EXERCISES}


def judge(
    parts: list[Part],
    folder: Path,  # in which they run
    wanted: list[str],  # keys to judge; the others are only defined
    without_package: bool,
    report: Callable[[dict[str, Any]], object],
) -> None:
    """Run the parts in order and report {"key": k} before, and the verdict after each exercise."""
    namespace: dict[str, Any] = {}
    installed = _functions()
    for key in set(wanted) - {part.key for part in parts}:
        lacking = f"the cell with checks.{BY_KEY[key].check}(...) is missing: put it back."
        report({"key": key, **vars(Verdict("missing", lacking)), "seconds": 0.0})
    for number, part in enumerate(parts, start=1):
        path = folder / f"cell_{number}.py"
        path.write_text(part.text, encoding="utf-8")
        known = {name: value for name, value in namespace.items() if not name.startswith("__")}
        if part.key in wanted:
            report({"key": part.key})
        begin, verdict = time.perf_counter(), None
        try:
            namespace, _ = call(partial(runpy.run_path, str(path), known), (), SECONDS)
        except (Stopped, NotImplementedError) as stop:
            verdict = Verdict(WRONG, f"the cell {str(stop) or 'is not written yet'}.")
        if part.key not in wanted:
            continue
        verdict = verdict or _verdict(BY_KEY[part.key], namespace.get(SUBMITTED), without_package)
        changed = [name for name, i in _functions().items() if installed.get(name, i) != i]
        if changed:
            replaced = f"the notebook replaces {changed[0]} of the package."
            verdict = Verdict(REFUSED, replaced, verdict.hint)
        seconds = round(time.perf_counter() - begin, 2)
        report({"key": part.key, **vars(verdict), "seconds": seconds})


def _verdict(exercise: Exercise, function: Any, without_package: bool) -> Verdict:
    used: set[str] = set()
    answer = _watched(function, exercise, used) if without_package else function
    try:
        verdict = getattr(checks, exercise.check)(answer)
    except Exception as error:  # a check that the answer has confused
        return Verdict(WRONG, f"the check stops with {type(error).__name__}: {error}.")
    if used:
        return Verdict(REFUSED, f"the answer calls {min(used)} of minislam: write it yourself.")
    return verdict


def _functions() -> dict[str, int]:
    """Return which functions and classes the loaded modules of the package hold, by name."""
    return {
        f"{name}.{key}": id(value)
        for name, module in list(sys.modules.items())
        if name.split(".")[0] == "minislam" and module is not None
        for key, value in list(vars(module).items())
        if callable(value)
    }


def _watched(function: Any, exercise: Exercise, used: set[str]) -> Callable[..., Any]:
    """Return the function, which notes what it calls of the package and may not call."""
    allowed = MAY_CALL.get(exercise.key, "").split()
    refused = MAY_NOT_CALL.get(exercise.key, "").split()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        name = code.co_qualname
        if event != "call" or not code.co_filename.startswith(PACKAGE) or name.endswith("__"):
            return
        caller = frame.f_back
        while caller is not None and caller.f_code is not run.__code__:
            if caller.f_code.co_filename.startswith(PACKAGE):
                return  # the package calls itself
            caller = caller.f_back
        in_geometry = "/geometry/" in code.co_filename.replace("\\", "/")
        if name in refused or not (in_geometry or name in allowed):
            used.add(name)

    def run(*arguments: Any) -> Any:
        sys.setprofile(watch)
        try:
            return function(*arguments)
        finally:
            sys.setprofile(None)

    return run


def main(folder: Path) -> None:
    """Judge the job of a folder."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the time limit needs it
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))

    def report(line: dict[str, Any]) -> None:
        with open(folder / "verdicts.txt", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    parts = parts_of(job["notebook"], [BY_KEY[key] for key in job["keys"]])
    judge(parts, folder, job["wanted"], job["without_package"], report)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
