"""log.txt: whole lines with their times, whatever the stream does."""

import io
import os
import re
import sys
from pathlib import Path

import pytest

from minislam.cli.log import Log, recorded


def texts(path: Path) -> list[str]:
    return [re.sub(r"^\S+ \S+  ", "", row) for row in path.read_text().splitlines()]


def begin(log: Log, folder: Path) -> None:
    """Let a run begin in a folder."""
    log.write_into(folder)
    (folder / "run.json").touch()


def test_lines_before_and_after_the_run_begins_are_in_it(tmp_path: Path):
    log = Log()
    log.add("one\n")
    log.write_into(tmp_path)
    log.add("two\nthr")
    assert not (tmp_path / "log.txt").exists()
    (tmp_path / "run.json").touch()
    log.add("ee\n")
    assert texts(tmp_path / "log.txt") == ["one", "two", "three"]


def test_the_log_of_an_earlier_run_gets_no_line_of_one_that_replaces_it_or_is_refused(
    tmp_path: Path, capsys
):
    log_file, run = tmp_path / "log.txt", tmp_path / "run.json"
    log_file.write_text("earlier\n")
    run.touch()
    os.utime(run, (1e9, 1e9))
    with pytest.raises(ValueError), recorded(is_quiet=False) as log:
        log.write_into(tmp_path)
        print("a warning")
        raise ValueError("the folder is in use")
    assert log_file.read_text() == "earlier\n"
    with recorded(is_quiet=False) as log:
        print("one")
        log.write_into(tmp_path)
        print("two")
        log_file.unlink()
        run.write_text("{}")
        print("three")
    assert texts(log_file) == ["one", "two", "three"]


def test_of_a_line_that_is_written_over_the_last_state_counts(tmp_path: Path):
    log = Log()
    begin(log, tmp_path)
    for text in ("\rwalking 1/2 (9 s left) ", "\rwalking 2/2            ", "\n"):
        log.add(text)
    assert texts(tmp_path / "log.txt") == ["walking 2/2"]


def test_a_command_that_is_refused_before_it_says_more_writes_nothing(tmp_path: Path, capsys):
    with pytest.raises(ValueError), recorded(is_quiet=False) as log:
        print("before")
        begin(log, tmp_path)
        raise ValueError("refused")
    assert not (tmp_path / "log.txt").exists()


def test_quiet_keeps_standard_output_from_the_terminal_but_not_from_the_log(tmp_path: Path, capsys):
    with pytest.raises(ValueError), recorded(is_quiet=True) as log:
        begin(log, tmp_path)
        print("a result")
        print("a warning", file=sys.stderr)
        raise ValueError("the end")
    assert capsys.readouterr() == ("", "a warning\n")
    assert texts(tmp_path / "log.txt") == ["a result", "a warning", "minislam: the end"]


def test_a_full_disk_ends_neither_the_run_nor_the_log(tmp_path: Path, monkeypatch):
    device = io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)
    with device as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        with recorded(is_quiet=False) as log:
            begin(log, tmp_path)
            (tmp_path / "log.txt").mkdir()  # where nothing can be written
            print("one")
            (tmp_path / "log.txt").rmdir()
            print("two")
    assert texts(tmp_path / "log.txt") == ["one", "two"]
