"""Of a student's notebook, what an exercise needs is kept, line by line, and nothing else."""

import ast

import pytest

from minislam.checks.points import EXERCISES
from minislam.checks.submission import exercises_of, parts_of
from minislam.errors import InputError

TWO = [e for e in EXERCISES if e.notebook == "03_splatting_gradients"][:2]
EXERCISE = '''import math

%timeit 3
SCALE: int
scale = math.sqrt(4.0)


def mine(V, conics, v):
    """Return V."""
    return scale * V


print("much" * 1000)
checks.check_conic_vjp(mine)'''


def notebook(*texts: str) -> dict:
    return {"cells": [{"cell_type": "code", "source": [text]} for text in texts]}


def test_an_exercise_keeps_its_lines_and_what_it_gives_to_the_check():
    [part] = parts_of(notebook(EXERCISE), TWO)
    assert part.key == TWO[0].key
    lines = part.text.splitlines()
    assert lines[4] == "scale = math.sqrt(4.0)" and lines[9] == "    return scale * V"
    assert "print" not in part.text and "timeit" not in part.text and "checks" not in part.text
    assert lines[-1] == "submitted_to_the_check = mine"


def test_only_what_python_calls_a_line_is_one():
    for separator in ("\u2028", "\x0c", "\x85", "\r"):
        text = EXERCISE.replace("Return V.", f"Return V.{separator}No more.")
        [part] = parts_of(notebook(text), TWO)
        assert "return scale * V" in part.text and ast.parse(part.text)


def test_other_cells_keep_imports_definitions_constants_and_the_dtype():
    text = (
        "from __future__ import annotations\nimport nowhere\nK = 3\nx = slow()\nm.f = 3\n"
        "torch.set_default_dtype(torch.float64)\nplt.show()\n\n\n@cache\ndef f():\n    return K\n"
    )
    [part] = parts_of(notebook(text), TWO)
    assert part.key == ""
    for kept in ("import nowhere", "K = 3", "set_default_dtype", "@cache\n", "return K"):
        assert kept in part.text
    for dropped in ("__future__", "slow", "m.f", "plt"):
        assert dropped not in part.text
    assert part.text.count("except Exception:") == 4


def test_an_assignment_with_a_type_is_kept_like_one_without():
    [part, exercise] = parts_of(notebook("K: float = 3.0\nL: int = slow()", EXERCISE), TWO)
    assert "K: float = 3.0" in part.text and "slow" not in part.text
    assert "SCALE" not in exercise.text  # it has no value


def test_a_line_may_begin_with_a_remainder():
    [part] = parts_of(notebook("def f(n):\n    return (\n        n\n        % 3\n    )\n"), TWO)
    assert "n % 3" in part.text


def test_a_cell_that_python_cannot_read_is_told():
    broken = EXERCISE.replace("def mine(", "def mine[")
    parts = parts_of(notebook("a = (", broken, "checks.check_twist_vjp(lambda *a: 0)"), TWO)
    assert [part.key for part in parts] == ["", TWO[0].key, TWO[1].key]
    assert parts[1].text == broken.replace("%timeit 3", "")  # the judge says where it breaks
    assert parts[2].text.endswith("submitted_to_the_check = lambda *a: 0\n")


def test_a_notebook_is_told_by_its_checks_or_by_its_name():
    assert exercises_of(notebook(EXERCISE), "homework.ipynb")[:2] == TWO
    assert exercises_of(notebook("x = 3"), "03_splatting_gradients (1).ipynb")[:2] == TWO
    with pytest.raises(InputError, match="found none of its exercises in x"):
        exercises_of(notebook("x = 3"), "x.ipynb")
    for content in ([], {"worksheets": []}, {"cells": [{"source": 3}]}, {"cells": 3}):
        with pytest.raises(InputError, match="expected a notebook with cells"):
            exercises_of(content, "03.ipynb")
