"""Progress lines, and how Ctrl-C ends a command between two steps."""

import re
import signal

import pytest

from minislam.cli.progress import ProgressLine


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


def test_ctrl_c_waits_for_the_end_of_a_step_and_a_second_does_not(capsys):
    before = signal.getsignal(signal.SIGINT)
    with ProgressLine() as progress:
        assert not progress.should_stop()
        signal.raise_signal(signal.SIGINT)
        assert progress.should_stop()
        progress.show("walking", 1, 1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    assert "stopping after this step; Ctrl-C again stops at once" in capsys.readouterr().err
