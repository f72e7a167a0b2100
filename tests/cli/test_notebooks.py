"""Copies of the notebooks: the same bytes, or without solutions, and never over others' work."""

import json
from pathlib import Path

import pytest

import minislam
from minislam.cli.main import main
from tests.notebook_files import NOTEBOOKS, ROOT, is_exercise, load

pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy")


def test_copies_are_the_notebooks(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["notebooks", str(tmp_path / "my course")]) == 0
    assert f"jupyter lab '{tmp_path / 'my course'}'" in capsys.readouterr().out
    copies = sorted((tmp_path / "my course").glob("*.ipynb"))
    assert [path.name for path in copies] == [path.name for path in NOTEBOOKS]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(copies, NOTEBOOKS, strict=True))
    for name in ("notebooks/SYLLABUS.md", "LICENSE"):
        copy = tmp_path / "my course" / Path(name).name
        assert copy.read_bytes() == (ROOT / name).read_bytes()


def test_copies_for_students_have_no_solution(tmp_path: Path):
    assert main(["notebooks", str(tmp_path), "--student"]) == 0
    for path in tmp_path.glob("*.ipynb"):
        text = path.read_text(encoding="utf-8")
        assert "SOLUTION" not in text
        solved = load(ROOT / "notebooks" / path.name)["cells"]
        assert ("NotImplementedError" in text) == any(map(is_exercise, solved))
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)


def test_files_that_a_notebook_names_come_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "site-packages/minislam"
    for name in ("images/a.png", "images/b.png", "data/rows.json"):
        (package / "notebooks" / name).parent.mkdir(parents=True, exist_ok=True)
        (package / "notebooks" / name).write_text(name)
    (package / "notebooks/00_first.ipynb").write_text('{"cells": ["images/a.png data/rows.json"]}')
    monkeypatch.setattr(minislam, "__file__", str(package / "__init__.py"))
    assert main(["notebooks", str(tmp_path / "course")]) == 0
    files = {p.relative_to(tmp_path / "course").as_posix() for p in tmp_path.glob("course/**/*.*")}
    assert files == {"00_first.ipynb", "images/a.png", "data/rows.json"}


def test_an_installed_package_brings_its_notebooks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "site-packages/minislam"
    (package / "notebooks").mkdir(parents=True)
    (package / "notebooks/00_first.ipynb").write_text('{"cells": []}')
    monkeypatch.setattr(minislam, "__file__", str(package / "__init__.py"))
    assert main(["notebooks", str(tmp_path / "course")]) == 0
    assert [path.name for path in (tmp_path / "course").iterdir()] == ["00_first.ipynb"]


def test_nobodys_work_is_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / NOTEBOOKS[3].name).write_text("my solution")
    assert main(["notebooks", str(tmp_path)]) == 1
    assert "expected a folder without these notebooks, found 03_" in capsys.readouterr().err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["my solution"]


@pytest.mark.parametrize("name", ["mine", "mine/a"])
def test_a_file_is_no_folder(tmp_path: Path, monkeypatch, capsys, name: str):
    monkeypatch.chdir(tmp_path)
    Path("mine").write_text("mine")
    assert main(["notebooks", name]) == 1
    said = capsys.readouterr().err
    assert said == (
        "minislam: expected an output folder, but mine is a file; choose another name\n"
    )
    assert Path("mine").read_text() == "mine"


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path, capsys):
    assert main(["notebooks", str(tmp_path / ("a" * 300))]) == 1
    assert "expected to make the folder" in capsys.readouterr().err


def test_a_package_without_notebooks_says_so(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(minislam, "__file__", str(tmp_path / "minislam/__init__.py"))
    assert main(["notebooks", str(tmp_path / "course")]) == 1
    assert "expected notebooks in" in capsys.readouterr().err
    assert not (tmp_path / "course").exists()
