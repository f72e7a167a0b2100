"""The sub-command `minislam grade`: points for students' notebooks."""

import argparse
import csv
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from os.path import expanduser
from pathlib import Path
from typing import Any

import minislam
from minislam.data.files import read_json, require_new, write_json, write_text
from minislam.errors import InputError
from minislam.parameters import require_bounds

SILENCE = 120.0  # seconds without a verdict after which an exercise is given up
VERDICTS = "verdicts.txt"  # to which the judge appends a line before and after each exercise
COLUMNS = "file key check status points of seconds sentence".split()


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "grade",
        help="points for the exercises of students' notebooks",
        description="Run the exercises of each notebook in a fresh process, only their definitions "
        "and imports, and count points with the installed checks. It runs the students' code: use "
        "an account that has nothing to lose. Exit code 0 when all notebooks were graded.",
    )
    add = parser.add_argument
    add("notebooks", metavar="NOTEBOOK", nargs="+", help="a student's .ipynb file")
    file = partial(add, type=expanduser, metavar="FILE")
    file("--json", help="write all verdicts as JSON")
    file("--csv", help="write one line an exercise")
    add("--overwrite", action="store_true", help="replace files of these names")
    add("--seed", type=int, metavar="N", help="also cases that nobody has seen")
    add("--no-package", action="store_true", help="refuse answers that call the package's own")
    add("--strict", action="store_true", help="exit code 1 below full marks")
    parser.set_defaults(run=_grade)


def _grade(args: argparse.Namespace) -> int:
    """Grade all notebooks, print and write the points; return the exit code."""
    require_bounds("--seed", args.seed, 0, 2**32 - 1)
    require_new([args.json, args.csv], args.overwrite, args.notebooks)
    graded = []
    for name in args.notebooks:
        try:
            result = _graded(Path(name), args.seed, args.no_package)
        except InputError as error:
            result = {"file": name, "error": str(error), "points": 0, "of": 0, "exercises": []}
        graded.append(result)
        print(result["file"])
        for row in result["exercises"]:
            print("  {key:7} {points}/{of}  {status:7}  {sentence}".format(**row))
        print("  " + result.get("error", "{points} of {of} points".format(**result)))
    points, of = sum(g["points"] for g in graded), sum(g["of"] for g in graded)
    if len(graded) > 1:
        print(f"all {len(graded)} notebooks: {points} of {of} points")
    if args.json:
        about = {"minislam": minislam.__version__, "seed": args.seed, "points": points, "of": of}
        write_json(args.json, {**about, "notebooks": graded})
    if args.csv:
        table = io.StringIO()
        writer = csv.DictWriter(table, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for notebook in graded:
            writer.writerows({"file": notebook["file"], **row} for row in notebook["exercises"])
        write_text(args.csv, table.getvalue())
    failed = any("error" in notebook for notebook in graded)
    return int(failed or (args.strict and points < of))


def _graded(path: Path, seed: int | None, without_package: bool) -> dict[str, Any]:
    """Return the points of one notebook; InputError if it is none of the course."""
    from minislam.checks.submission import exercises_of

    notebook = read_json(path)
    exercises = exercises_of(notebook, path.name)
    job = {"notebook": notebook, "keys": [e.key for e in exercises]}
    verdicts = _judged({**job, "without_package": without_package}, seed)
    rows = []
    for exercise in exercises:
        verdict = verdicts[exercise.key]
        points = exercise.points if verdict["status"] == "passed" else 0
        about = {"check": exercise.check, "points": points, "of": exercise.points}
        rows.append({"key": exercise.key, **about, **verdict})  # in the columns' order
    points, of = sum(row["points"] for row in rows), sum(row["of"] for row in rows)
    about = {"file": str(path), "notebook": exercises[0].notebook}
    return {**about, "points": points, "of": of, "exercises": rows}


def _judged(job: dict[str, Any], seed: int | None) -> dict[str, dict[str, Any]]:
    """Return the verdict of each exercise, whatever its code does to the judge's process."""
    verdicts: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        while remaining := [key for key in job["keys"] if key not in verdicts]:
            write_json(folder / "job.json", {**job, "wanted": remaining})
            (folder / VERDICTS).write_text("", encoding="utf-8")
            ending = _run_judge(folder, seed)
            ended = {"status": "wrong", "sentence": ending, "hint": "", "seconds": 0.0}
            lines = (folder / VERDICTS).read_bytes().splitlines()
            begun = [row for row in map(_row, lines) if row.get("key") in remaining]
            # Who ends the process before any exercise has begun would do so again.
            for row in begun or [{"key": key} for key in remaining]:
                verdicts[row["key"]] = ended | row
    return verdicts


def _row(line: bytes) -> dict[str, Any]:
    """Return a line of the judge; nothing if it is half written, or the student's own."""
    with suppress(ValueError, RecursionError):
        row = json.loads(line)
        return row if isinstance(row, dict) else {}
    return {}


def _run_judge(folder: Path, seed: int | None) -> str:
    """Run minislam.checks.judge; return a sentence for the exercise it did not come back from."""
    root = str(Path(minislam.__file__).parents[1])
    environment = {name: v for name, v in os.environ.items() if not name.startswith("MINISLAM_S")}
    path = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    environment |= {"PYTHONPATH": path, "MPLBACKEND": "Agg"}
    if seed is not None:
        environment["MINISLAM_SEED"] = str(seed)
    command = [sys.executable, "-P", "-m", "minislam.checks.judge", str(folder)]
    null = subprocess.DEVNULL  # of what the notebook prints
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdin=null, stdout=null, stderr=null
    ) as process:
        size, since = 0, time.monotonic()
        while process.poll() is None:
            time.sleep(0.05)
            if (now := (folder / VERDICTS).stat().st_size) != size:
                size, since = now, time.monotonic()
            if time.monotonic() - since > SILENCE:
                process.kill()
                return f"it has no answer after {SILENCE:.0f} seconds."
    return f"it ends the whole program (exit code {process.returncode})."
