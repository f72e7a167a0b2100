"""Progress lines, and how Ctrl-C ends a command between two steps."""

import io
import re
import signal
import sys

import pytest

from minislam.cli.progress import ENDING, ProgressLine, ending_signals, say


def test_off_a_terminal_a_stage_prints_a_line_every_tenth(capsys):
    progress = ProgressLine()
    for done in range(1, 201):
        progress.show("walking", done, 200)
        if done == 100:
            progress.show("resting", 1, 1)  # another stage in between
    lines = capsys.readouterr().err.splitlines()
    walking = [line for line in lines if line.startswith("walking: ")]
    assert len(walking) == 10 and "resting: 1/1 (0 s)" in lines
    assert re.fullmatch(r"walking: 40/200 \([\d.]+/s, \d+ s left\)", walking[1])
    assert re.fullmatch(r"walking: 200/200 \(\d+ s\)", walking[-1])


def test_a_warning_has_a_line_of_its_own(capsys):
    progress = ProgressLine()
    progress.show("walking", 1, 10)
    progress.warn("frame 3: the camera is lost")
    assert capsys.readouterr().err.splitlines()[-1] == "WARNING: frame 3: the camera is lost"


@pytest.mark.parametrize("name", ENDING)
def test_a_signal_waits_for_the_end_of_a_step_and_a_second_does_not(name: str, capsys):
    number = getattr(signal, name)
    before = signal.getsignal(number)
    progress = ProgressLine()
    with ending_signals(progress.interrupt):
        assert not progress.should_stop()
        signal.raise_signal(number)
        assert progress.should_stop()
        progress.show("walking", 1, 1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before
    assert "stopping after this step; Ctrl-C again stops at once" in capsys.readouterr().err


def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
    try:
        with ending_signals(signal.default_int_handler):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_nobody_who_listens_ends_no_run(monkeypatch):
    full = io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)
    with full, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", full)
        ProgressLine().show("walking", 1, 1)
        assert sys.stderr is not full
        say("more", "stderr")
