"""`minislam grade`: points, one sentence for each trouble, files; the code runs elsewhere."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from minislam.checks.points import EXERCISES
from minislam.cli import grade
from minislam.cli.main import main
from minislam.cli.notebooks import as_text, without_solutions
from tests.notebook_files import NOTEBOOKS, ROOT, is_exercise, load, source

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy"),
]


def solved(number: str) -> dict:
    return load(next(path for path in NOTEBOOKS if path.name.startswith(number)))


def exercise_cells(notebook: dict) -> list[dict]:
    return [cell for cell in notebook["cells"] if is_exercise(cell)]


def written(path: Path, notebook: dict) -> str:
    path.write_text(as_text(notebook), encoding="utf-8")
    return str(path)


def test_a_wrong_answer_loses_just_its_points(tmp_path: Path, capsys):
    notebook = solved("03")
    cell = exercise_cells(notebook)[1]
    cell["source"] = [source(cell).replace("    return ", "    return -1 * ")]
    name = written(tmp_path / "ann.ipynb", notebook)
    files = ["--json", str(tmp_path / "marks.json"), "--csv", str(tmp_path / "marks.csv")]
    assert main(["grade", name, *files, "--seed", "5", "--no-package"]) == 0
    lines = capsys.readouterr().out.splitlines()
    most = sum(e.points for e in EXERCISES if e.notebook.startswith("03_"))
    assert lines[0] == name and lines[1].startswith("  ex03_1  2/2  passed   ")
    assert lines[2].startswith("  ex03_2  0/2  wrong    for means alone")
    assert lines[-1] == f"  {most - 2} of {most} points"
    [ann] = json.loads((tmp_path / "marks.json").read_text())["notebooks"]
    assert (ann["points"], ann["of"]) == (most - 2, most)
    assert ann["exercises"][1]["hint"] == "The sign is the other one."
    rows = list(csv.DictReader((tmp_path / "marks.csv").open()))
    assert [row["points"] for row in rows[:2]] == ["2", "0"]
    assert {row["file"] for row in rows} == {name} and len(rows) == len(ann["exercises"])


def test_a_line_that_is_half_written_or_forged_ends_no_grading(monkeypatch):
    begun, passed = '{"key": "ex03_1"}', '{"key": "ex03_1", "status": "passed"}'
    for last, status in ((passed, "passed"), (passed[:-9], "wrong"), ('["ex03_1"]', "wrong")):

        def judged(folder: Path, seed: int | None, last: str = last) -> str:
            lines = [begun, last, '{"key": "ex99_1"}', "5"]
            (folder / grade.VERDICTS).write_text("\n".join(lines))
            return "it ends"

        monkeypatch.setattr(grade, "_run_judge", judged)
        [(key, verdict)] = grade._judged({"keys": ["ex03_1"]}, None).items()
        assert key == "ex03_1" and verdict["status"] == status


def test_each_trouble_is_one_sentence(tmp_path: Path, capsys):
    notebook = solved("03")
    first, second = exercise_cells(notebook)[:2]
    first["source"] = [
        "import os\nprint('xxx' * 9999)\nchecks.check_conic_vjp(lambda *a: os._exit(1))"
    ]
    second["source"] = [source(second).replace("checks.check_twist_vjp(my_twist_vjp)", "")]
    notebook["cells"] = [first, second]
    names = [written(tmp_path / "03_all.ipynb", notebook), str(tmp_path / "none.ipynb")]
    (tmp_path / "half.ipynb").write_text('{"cells": [')
    assert main(["grade", *names, str(tmp_path / "half.ipynb")]) == 1
    out, err = capsys.readouterr()
    assert "ex03_1  0/2  wrong    it ends the whole program (exit code 1)." in out
    assert "ex03_2  0/2  missing  the cell with checks.check_twist_vjp(...) is missing: put" in out
    assert "expected a readable file" in out and "expected JSON in" in out
    assert "Traceback" not in out + err and "xxx" not in out


def test_an_endless_judge_is_ended(tmp_path: Path, monkeypatch):
    (tmp_path / "verdicts.txt").write_text("")
    (tmp_path / "job.json").write_text("{}")
    monkeypatch.setattr(grade, "SILENCE", 0.2)
    assert grade._run_judge(tmp_path, None) == "it has no answer after 0 seconds."


def test_strict_needs_full_marks_and_a_seed_is_a_number(tmp_path: Path, capsys):
    for seed in ("-1", "9" * 20):  # torch takes no seed as large
        assert main(["grade", "x.ipynb", "--seed", seed]) == 1
        assert "expected --seed of at least 0 and at most 4.29" in (err := capsys.readouterr().err)
        assert f"found {seed};" in err
    full = {"file": "a", "points": 4, "of": 4, "exercises": []}
    for points, code in ((4, 0), (2, 1)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(grade, "_graded", lambda *a, p=points: {**full, "points": p})
            assert main(["grade", "a.ipynb", "--strict"]) == code
            assert main(["grade", "a.ipynb"]) == 0


def test_files_of_the_teacher_and_of_the_students_stay(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    full = {"file": "a", "points": 4, "of": 4, "exercises": []}
    for name in ("a.ipynb", "marks.json", "marks.csv"):
        Path(name).write_text("mine")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grade, "_graded", lambda *_: pytest.fail("it grades"))
        for words in ("--json marks.json", "--csv marks.csv", "--csv a.ipynb --overwrite"):
            assert main(["grade", "a.ipynb", *words.split()]) == 1
            assert f"expected a new file, but {words.split()[1]} exists" in capsys.readouterr().err
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}
    monkeypatch.setattr(grade, "_graded", lambda *_: full)
    assert main(["grade", "a.ipynb", "--json", "marks.json", "--overwrite"]) == 0
    assert json.loads(Path("marks.json").read_text())["points"] == 4


def test_strict_mode_fails_in_nbmake_where_an_answer_is_missing(tmp_path: Path):
    notebook = solved("04")
    first = next(cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    first["source"] = ["import torch\n\nfrom minislam import checks"]  # starts sooner
    notebook["cells"] = [first, *exercise_cells(notebook)[:2]]
    written(tmp_path / "solved.ipynb", notebook)
    written(tmp_path / "student.ipynb", without_solutions(notebook))
    command = [sys.executable, "-m", "pytest", "-q", "--nbmake", "--color=no", "."]
    environment = {**os.environ, "MINISLAM_STRICT": "1", "PYTHONPATH": str(ROOT)}
    found = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert "1 failed, 1 passed" in found.stdout, found.stdout
    assert "WrongAnswer" in found.stdout and ": Not yet: write the body" in found.stdout
