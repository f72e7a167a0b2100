"""However the command line ends: one sentence, run.json says how, nothing is lost."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from minislam.cli.main import main
from minislam.data.run_folder import locked
from minislam.slam import Slam
from tests.cli.test_main import images, run, texture, the_sentence

pytestmark = pytest.mark.slow

# The net: whatever else goes wrong


@pytest.mark.parametrize(
    "error",
    [OSError(28, "No space left"), MemoryError("9 TB"), OverflowError("fx**2"), cv2.error("alloc")],
)
def test_a_foreign_error_is_one_sentence_too(error: Exception, tmp_path: Path, monkeypatch, capsys):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(Slam, "run", fail)
    source, out = images(tmp_path / "input", [texture(0), texture(3)]), tmp_path / "out"
    assert run(source, "-o", out) == 1
    said = the_sentence(capsys)
    assert type(error).__name__ in said and "set MINISLAM_DEBUG=1" in said
    assert json.loads((out / "run.json").read_text())["state"] == f"failed: {error}"
    monkeypatch.setenv("MINISLAM_DEBUG", "1")
    with pytest.raises(type(error)):
        run(source, "-o", tmp_path / "again")


def test_on_a_terminal_the_last_sentence_is_not_behind_an_open_progress_line(monkeypatch, capsys):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("minislam.cli.main._command", interrupted)
    assert main(["run"]) == 130
    assert capsys.readouterr().err.rstrip() == "\rminislam: interrupted"


@pytest.mark.parametrize("source", ["~nouserhere/x", "a" * 5000, "a\0b"])
def test_a_name_that_no_system_knows_is_one_sentence(source: str, tmp_path: Path, capsys):
    assert run(source, "-o", tmp_path / "out") == 1
    sentence = the_sentence(capsys)
    assert len(sentence) < 600 and "to finish this command" not in sentence
    assert run(images(tmp_path / "input", [texture(0)]), "-o", tmp_path / source) == 1
    the_sentence(capsys)


def full_device() -> io.TextIOWrapper:
    return io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)


def test_the_end_of_a_reader_is_no_error():
    command = f"{sys.executable} -m minislam weights list | true"
    assert subprocess.run(["bash", "-c", command], capture_output=True).stderr == b""


def test_a_stream_that_the_caller_has_closed_gives_its_number_to_nothing_else():
    code = (
        "import os, sys; from minislam.cli import main as module\n"
        "module._command = lambda _: [os.fstat(number) for number in range(3)] and 0\n"
        "sys.exit(module.main(['run']))"
    )
    command = f'{sys.executable} -c "{code}" <&- >&- 2>&-'
    assert subprocess.run(["bash", "-c", command]).returncode == 0


def test_numbers_that_cannot_be_printed_are_an_error(tmp_path: Path, monkeypatch, capsys):
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{k} {k} {k * k % 5} 0 0 0 0 1\n" for k in range(6)))
    with full_device() as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        assert main(["eval", str(path), str(path)]) == 1
    assert "No space left" in the_sentence(capsys)


def test_a_run_of_a_strange_name_that_nobody_listens_to_and_its_pictures(
    tmp_path: Path, monkeypatch, capsys
):
    source, out = images(tmp_path / "in", [texture(0), texture(3)]), tmp_path / "out"
    source = source.rename(tmp_path / os.fsdecode(b"bad\xff"))  # no UTF-8
    with full_device() as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        patch.setattr(sys, "stderr", None)  # 2>&-
        assert run(source, "-o", out, "--mapping.refine_iterations", "2") == 0
    assert json.loads((out / "run.json").read_text())["state"] == "finished"
    assert json.loads((out / "config.json").read_text())["sequence"] == str(source)

    before = {path: path.is_file() and path.read_bytes() for path in out.rglob("*")}
    assert run(out / "keyframes", "-o", out, "--overwrite") == 1
    assert "nothing was removed" in the_sentence(capsys)
    assert {path: path.is_file() and path.read_bytes() for path in out.rglob("*")} == before


def test_a_folder_with_a_run_in_it_is_refused(tmp_path: Path, capsys):
    source = images(tmp_path / "in", [texture(0), texture(3)])
    with locked(tmp_path / "out"):
        assert run(source, "-o", tmp_path / "out") == 1
    assert "for this run alone, found another one in it" in the_sentence(capsys)
    assert not list((tmp_path / "out").iterdir())
