"""log.txt: whole lines with their times, whatever the stream does."""

import io
import re
import sys
from pathlib import Path

import pytest

from minislam.cli.log import Log, recorded


def texts(path: Path) -> list[str]:
    return [re.sub(r"^\S+ \S+  ", "", row) for row in path.read_text().splitlines()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a run that has begun."""
    (tmp_path / "run.json").touch()
    return tmp_path


def test_lines_before_and_after_the_run_begins_are_in_it(tmp_path: Path):
    log = Log()
    log.add("one\n")
    log.folder = tmp_path
    log.add("two\nthr")
    assert not (tmp_path / "log.txt").exists()
    (tmp_path / "run.json").touch()
    log.add("ee\n")
    assert texts(tmp_path / "log.txt") == ["one", "two", "three"]


def test_of_a_line_that_is_written_over_the_last_state_counts(folder: Path):
    log = Log()
    log.folder = folder
    for text in ("\r\033[Kwalking 1/2", "\r\033[Kwalking 2/2", "\n"):
        log.add(text)
    assert texts(folder / "log.txt") == ["walking 2/2"]


def test_a_command_that_is_refused_before_it_says_more_writes_nothing(folder: Path, capsys):
    with pytest.raises(ValueError), recorded(is_quiet=False) as log:
        print("before")
        log.folder = folder
        raise ValueError("refused")
    assert not (folder / "log.txt").exists()


def test_quiet_keeps_standard_output_from_the_terminal_but_not_from_the_log(folder, capsys):
    with pytest.raises(ValueError), recorded(is_quiet=True) as log:
        log.folder = folder
        print("a result")
        print("a warning", file=sys.stderr)
        raise ValueError("the end")
    assert capsys.readouterr() == ("", "a warning\n")
    assert texts(folder / "log.txt") == ["a result", "a warning", "minislam: the end"]


def test_a_full_disk_ends_neither_the_run_nor_the_log(folder: Path, monkeypatch):
    device = io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)
    with device as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        with recorded(is_quiet=False) as log:
            log.folder = folder
            (folder / "log.txt").mkdir()  # where nothing can be written
            print("one")
            (folder / "log.txt").rmdir()
            print("two")
    assert texts(folder / "log.txt") == ["one", "two"]
