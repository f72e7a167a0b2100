"""The notebooks in git are one clean run each, and the student copies work too.

That they still run is checked by nbmake; here it is checked what is stored.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.notebook_files import NOTEBOOKS, as_text, cleaned, load, source, without_solutions

LARGEST = 500_000  # bytes
LONGEST_CELL = 15  # lines
MOST_CELLS = 25
MACHINE_PATH = re.compile(r"(?<![\w.])(/home/|/Users/|/root/|/tmp/|[A-Z]:\\\\)")

pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy")
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(path: Path) -> list[dict]:
    return [cell for cell in load(path)["cells"] if cell["cell_type"] == "code"]


@each_notebook
def test_it_is_stored_as_one_clean_run(path: Path):
    counts = [cell["execution_count"] for cell in code_cells(path)]
    assert counts == list(range(1, len(counts) + 1))
    kinds = [output["output_type"] for cell in code_cells(path) for output in cell["outputs"]]
    assert kinds and "error" not in kinds
    streams = [o for cell in code_cells(path) for o in cell["outputs"] if o.get("name") == "stderr"]
    assert not streams, "a warning is stored"


@each_notebook
def test_it_is_small_and_in_the_stored_form(path: Path):
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST
    assert text == as_text(cleaned(json.loads(text))), "run python -m tests.refresh_notebooks"
    assert load(path)["metadata"]["kernelspec"]["name"] == "python3"


@each_notebook
def test_its_cells_are_short(path: Path):
    cells = load(path)["cells"]
    assert len(cells) <= MOST_CELLS
    for cell in cells:
        if cell["cell_type"] == "code":
            assert len(source(cell).splitlines()) <= LONGEST_CELL, source(cell)


@each_notebook
def test_it_names_no_path_of_a_machine(path: Path):
    for cell in load(path)["cells"]:
        assert not MACHINE_PATH.search(source(cell)), source(cell)
        for output in cell.get("outputs", []):
            text = "".join(output.get("text", output.get("data", {}).get("text/plain", "")))
            assert not MACHINE_PATH.search(text), text


@each_notebook
def test_it_opens_like_a_lesson(path: Path):
    first = source(load(path)["cells"][0])
    assert re.match(r"# \d\d ", first), "the title starts with the notebook's number"
    assert all(words in first for words in ("You will learn", "You need", "Time"))


@each_notebook
def test_every_check_has_passed_in_the_stored_run(path: Path):
    for cell in code_cells(path):
        if re.search(r"^checks\.", source(cell), re.M):
            answers = ["".join(o["data"]["text/plain"]) for o in cell["outputs"] if "data" in o]
            assert answers and answers[-1].startswith("Passed"), (source(cell), answers)


def test_the_student_copy_has_the_signature_and_no_solution():
    text = "def f(x: int) -> int:\n    ### BEGIN SOLUTION\n    return x\n    ### END SOLUTION\n"
    notebook = {"cells": [{"cell_type": "code", "source": [text], "outputs": [1]}]}
    stripped = source(without_solutions(notebook)["cells"][0])
    assert stripped == "def f(x: int) -> int:\n    raise NotImplementedError  # your code here\n"


RUN_CELLS = """
import json, sys
cells = [c for c in json.load(sys.stdin)["cells"] if c["cell_type"] == "code"]
namespace = {"__name__": "__main__"}
for cell in cells:
    *head, last = "".join(cell["source"]).rstrip().split("\\n") or [""]
    exec("\\n".join([*head, f"print({last})" if last.startswith("checks.") else last]), namespace)
"""


@each_notebook
def test_the_student_copy_runs_and_every_check_says_not_yet(path: Path):
    stripped = without_solutions(load(path))
    exercises = [c for c in stripped["cells"] if "NotImplementedError" in source(c)]
    if not exercises:
        return
    command = [sys.executable, "-c", RUN_CELLS]
    environment = {**__import__("os").environ, "MPLBACKEND": "agg"}
    done = subprocess.run(
        command, input=json.dumps(stripped), text=True, capture_output=True, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    answers = [line for line in done.stdout.splitlines() if line.startswith(("Not yet", "Passed"))]
    assert len(answers) >= len(exercises), done.stdout[-2000:]
    assert all(line.startswith("Not yet") for line in answers), answers
