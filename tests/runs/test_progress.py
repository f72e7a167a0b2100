"""Progress lines, and how Ctrl-C ends a command between two steps."""

import io
import os
import re
import signal
import sys
import threading
import time
from itertools import count, pairwise

import pytest

from minislam.runs.progress import (
    ENDING,
    ProgressLine,
    _duration,
    ending_signals,
    quoted,
    say,
)


def terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    """Make standard error a terminal."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((columns, 24)))


def test_off_a_terminal_a_stage_prints_a_line_every_tenth(monkeypatch, capsys):
    monkeypatch.setattr("time.perf_counter", count().__next__)
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


def test_steps_that_are_reported_at_once_tell_no_rate(monkeypatch, capsys):
    clock = iter((0.0, 0.001, 0.002, 5.0))
    monkeypatch.setattr("time.perf_counter", clock.__next__)
    progress = ProgressLine(is_verbose=True)
    for done in (1, 3, 4, 11):
        progress.show("coarse depth", done, 34)
    rates = [line.partition("/34")[2] for line in capsys.readouterr().err.splitlines()]
    assert rates == ["", "", "", " (2.0/s, 12 s left)"]


def test_a_warning_has_a_line_of_its_own(capsys):
    progress = ProgressLine()
    progress.show("walking", 1, 10)
    progress.warn("frame 3: the camera is lost")
    assert capsys.readouterr().err.splitlines()[-1] == "WARNING: frame 3: the camera is lost"


def test_on_a_terminal_an_open_line_is_ended_once_and_a_signal_takes_its_place(monkeypatch, capsys):
    terminal(monkeypatch, columns=80)
    progress = ProgressLine()
    progress.show("walking", 1, 10)
    assert capsys.readouterr().err == f"\r{'walking: 1/10':<79}"
    progress.interrupt(2, None)
    progress.close()  # nothing is open
    stopping = "stopping after this step; Ctrl-C again stops at once"
    assert capsys.readouterr().err == f"\r{stopping:<79}\n"
    later = time.perf_counter() + 1
    monkeypatch.setattr("time.perf_counter", lambda: later)
    progress.show("walking", 2, 10)
    progress.close()
    assert capsys.readouterr().err.rstrip().endswith("/s, 8 s left)")
    progress.show("walking", 10, 10)
    assert capsys.readouterr().err.rstrip(" \n").endswith(" s)")
    progress.close()
    assert capsys.readouterr().err == ""


def test_on_a_narrow_terminal_a_line_fills_no_row_until_it_ends(monkeypatch, capsys):
    terminal(monkeypatch, columns=20)
    progress = ProgressLine()
    for done in range(1, 10):
        progress.show("adjusting the poses", done, 10)
    assert capsys.readouterr().err == 9 * "\radjusting the poses"
    progress.show("adjusting the poses", 10, 10)
    assert capsys.readouterr().err == "\radjusting the poses: 10/10 (0 s)\n"


def test_a_printed_command_can_be_pasted(monkeypatch):
    assert quoted("C:/a b/it's") == "'C:/a b/it'\"'\"'s'" and quoted("a/b") == "a/b"
    with monkeypatch.context() as patch:
        patch.setattr(os, "name", "nt")
        assert quoted("C:\\a b") == '"C:\\a b"' and quoted("C:\\ab") == "C:\\ab"


def test_a_signal_in_the_middle_of_a_print_ends_nothing(monkeypatch):
    def reentrant(*_: object) -> None:
        raise RuntimeError("reentrant call inside <_io.BufferedWriter>")

    progress = ProgressLine()
    monkeypatch.setattr(progress, "tell", reentrant)
    progress.interrupt(2, None)
    assert progress.should_stop()


@pytest.mark.parametrize("name", ENDING)
def test_a_signal_waits_for_the_end_of_a_step_and_a_second_does_not(name: str, capsys):
    number = getattr(signal, name)
    before = signal.getsignal(number)
    progress = ProgressLine()
    with ending_signals(progress.interrupt):
        assert not progress.should_stop()
        signal.raise_signal(number)
        assert progress.should_stop()
        assert "stopping after this step; Ctrl-C again stops at once" in capsys.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` does
    try:
        with ending_signals(signal.default_int_handler):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_a_program_around_python_handles_stays_so(monkeypatch):
    asked = signal.getsignal  # None stands for a handler that Python did not set
    monkeypatch.setattr(signal, "getsignal", lambda n: None if n == signal.SIGTERM else asked(n))
    before = asked(signal.SIGTERM)
    with ending_signals(lambda *_: None):
        assert asked(signal.SIGTERM) is before
    assert asked(signal.SIGTERM) is before


def test_without_a_console_nothing_is_shown_and_nothing_fails(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    ProgressLine().show("walking", 1, 1)


def test_in_another_thread_nothing_is_handled_and_nothing_fails():
    before, seen = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with ending_signals(lambda *_: None):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


def test_nobody_who_listens_ends_no_run(monkeypatch):
    full = io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)
    with full, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", full)
        ProgressLine().show("walking", 1, 1)
        assert sys.stderr is not full
        say("more", "stderr")


# The time of the whole run


def seconds_said(seconds_per_planned: float, monkeypatch, capsys) -> list[float]:
    """Return what is said of the whole run, by a clock that is slower than the plan."""
    clock = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    progress = ProgressLine(is_verbose=True)
    progress.plan = [{"walking": 20.0, "resting": 10.0}, {"resting": 10.0, "": 10.0}]
    for name, seconds in [("walking", 20.0), ("resting", 10.0), ("resting", 10.0)]:
        for done in range(21):
            progress.show(name, done, 20)
            clock[0] += seconds / 20 * seconds_per_planned
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("stage 1 of 2, walking: 0/20")
    assert lines[-1].startswith("stage 2 of 2, resting: 20/20")
    return [float(re.search(r"about (\d+) s in all", line)[1]) for line in lines]


@pytest.mark.parametrize("slowness", [0.5, 1.0, 1.7])
def test_the_whole_is_estimated_from_the_plan_and_then_from_what_was_measured(
    slowness: float, monkeypatch, capsys
):
    said = seconds_said(slowness, monkeypatch, capsys)
    assert said[0] == 50 and said[-1] == pytest.approx(50 * slowness, abs=6)
    steps = [abs(b - a) for a, b in pairwise(said)]
    assert max(steps) <= 5  # it does not jump
    assert abs(said[20] - 50 * slowness) < 0.35 * 50 * abs(slowness - 1) + 6


def test_a_part_that_is_not_planned_is_shown_in_the_present_stage(capsys):
    progress = ProgressLine()
    progress.plan = [{"walking": 20.0}, {"resting": 10.0}]
    for name in ("walking", "looking", "resting"):
        progress.show(name, 1, 1)
    starts = [line.partition(":")[0] for line in capsys.readouterr().err.splitlines()]
    assert starts == ["stage 1 of 2, walking", "stage 1 of 2, looking", "stage 2 of 2, resting"]


def test_a_run_that_begins_anew_is_in_its_first_stage_again(capsys):
    progress = ProgressLine(is_verbose=True)
    progress.plan = [{"walking": 20.0, "looking": 1.0}, {"resting": 10.0, "looking": 1.0}]
    for name in ("walking", "resting", "looking"):
        progress.show(name, 1, 1)
    progress.show("walking", 0, 1)
    progress.show("resting", 1, 1)
    lines = capsys.readouterr().err.splitlines()
    assert [int(line[len("stage ")]) for line in lines] == [1, 2, 2, 1, 2]
    assert lines[3].endswith("about 30 s in all")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(1, "5 s"), (62, "60 s"), (116, "115 s"), (118, "2 min"), (330, "5.5 min"), (660, "11 min"),
     (5399, "90 min"), (5400, "1.5 h"), (36000, "10.0 h")],
)  # fmt: skip
def test_a_duration_is_in_the_unit_that_people_use(seconds: int, words: str):
    assert _duration(seconds) == words


def test_items_are_counted_when_done_and_a_stage_that_comes_again_is_timed_anew(
    monkeypatch, capsys
):
    monkeypatch.setattr("time.perf_counter", count(0, 10).__next__)
    terminal(monkeypatch, columns=80)
    progress = ProgressLine(is_verbose=True)  # a line each, on a terminal, too
    for _ in range(2):
        assert [*progress.over("copying", "ab", 2)] == ["a", "b"]
    assert capsys.readouterr().err == 2 * "copying: 1/2\ncopying: 2/2 (10 s)\n"
