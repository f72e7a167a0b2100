"""Copies of the notebooks: the same bytes, or without solutions, and never over others' work."""

import json
from pathlib import Path

import pytest

import minislam
from minislam.cli.main import main
from tests.notebook_files import NOTEBOOKS

pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy")


def test_copies_are_the_notebooks(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["notebooks", str(tmp_path / "course")]) == 0
    assert f"jupyter lab {tmp_path / 'course'}" in capsys.readouterr().out
    copies = sorted((tmp_path / "course").iterdir())
    assert [path.name for path in copies] == [path.name for path in NOTEBOOKS]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(copies, NOTEBOOKS, strict=True))


def test_copies_for_students_have_no_solution(tmp_path: Path):
    assert main(["notebooks", str(tmp_path), "--student"]) == 0
    for path in tmp_path.iterdir():
        text = path.read_text(encoding="utf-8")
        assert "SOLUTION" not in text and "NotImplementedError" in text, path.name
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        assert not any(cell["outputs"] or cell["execution_count"] for cell in cells)


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


def test_a_package_without_notebooks_says_so(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(minislam, "__file__", str(tmp_path / "minislam/__init__.py"))
    assert main(["notebooks", str(tmp_path / "course")]) == 1
    assert "expected notebooks in" in capsys.readouterr().err
    assert not (tmp_path / "course").exists()
