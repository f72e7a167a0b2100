"""What a long command shows while it works, and how a signal ends it between two steps."""

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TypeVar

Item = TypeVar("Item")

EARLY = 0.1  # second; steps that a stage reports so early were done together: no rate yet
PLAIN_STEP = 0.1  # fraction of a stage between two progress lines that are not on a terminal
TRUST = 0.1  # fraction of the plan by which it resists the first measurements

ENDING = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C, a scheduler, a closed terminal (not Windows)


def say(text: str, stream: str = "stdout", end: str = "\n") -> None:
    """Print, but let no reader that ends (`| head`), no full disk, no closed stream end a run."""
    try:
        print(text, end=end, file=getattr(sys, stream), flush=True)
    except (OSError, ValueError):  # ValueError: a closed file
        setattr(sys, stream, open(os.devnull, "w"))


def quoted(argument: str) -> str:
    """Return an argument of a command that is printed, as a shell of this system takes it."""
    return subprocess.list2cmdline([argument]) if os.name == "nt" else shlex.quote(argument)


@contextmanager
def ending_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Handle what asks a program to end; what is ignored already (`nohup`) stays so.

    Python lets only the main thread do so; in another one nothing is handled. What a program around
    Python handles (None) stays so, too, because it could not be given back.
    """
    is_main = threading.current_thread() is threading.main_thread()
    numbers = [getattr(signal, name) for name in ENDING if is_main and hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    before = {n: earlier for n, earlier in before.items() if earlier not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


class ProgressLine:
    """One line per stage with its rate, and the time of the whole run if there is a plan.

    Off a terminal it is a plain line every 10 %. The first signal to `interrupt` waits for the end
    of the step, when the state is consistent. A second one ends the program at once.
    """

    def __init__(self, is_quiet: bool = False, is_verbose: bool = False) -> None:
        self.plan: list[dict[str, float]] = []  # of `plan_of`; without it, no time of the whole
        self._begun: dict[str, tuple[float, int]] = {}  # stage: time [s] and steps when first shown
        self._shown: dict[str, float] = defaultdict(float)  # stage: done in the last plain line
        self._stage = 0  # of the plan
        self._done: dict[tuple[int, str], float] = defaultdict(float)  # of each part of a stage
        self._start: tuple[float, float] | None = None  # time [s] and planned seconds done then
        self._stream = "stdout" if is_quiet else "stderr"  # a quiet stdout still reaches log.txt
        is_terminal = sys.stderr is not None and sys.stderr.isatty()  # None: no console at all
        self._terminal = is_terminal and not (is_quiet or is_verbose)
        self._plain_step = 0.0 if is_verbose else PLAIN_STEP
        self.warned: set[str] = set()  # what the user has been told
        self._should_stop = False
        self._is_open = False  # on a terminal: the line has no end yet

    def show(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of all steps of a stage are done. Stages may alternate."""
        now = time.perf_counter()
        start, done_at_start = self._begun.setdefault(stage, (now, done))
        seconds, steps = now - start, done - done_at_start
        fraction = done / max(total, 1)
        number, in_all = self._whole(stage, fraction, now)
        text = f"{number}{stage}: {done}/{total}"
        if done >= total:
            text += f" ({seconds:.0f} s)"
            del self._begun[stage]  # it may come again
        elif steps and seconds >= EARLY:
            rate = steps / seconds
            left = "" if in_all else f", {(total - done) / rate:.0f} s left"
            text += f" ({rate:.1f}/s{left})"
        text += in_all
        if self._terminal:
            self._is_open = fraction < 1
            if self._is_open:  # what has filled a row cannot be written over
                width = _width()
                say(f"\r{text[:width]:<{width}}", "stderr", end="")
            else:
                self.tell(text)
        elif fraction >= 1 or fraction >= self._shown[stage] + self._plain_step:
            self._shown[stage] = fraction % 1  # 0 when it is done, since it may come again
            say(text, self._stream)

    def _whole(self, name: str, fraction: float, now: float) -> tuple[str, str]:
        """Return which stage of the plan this is, and how long the run takes in all.

        The part that is left is assumed to take as many times its planned time as the part that
        is done took. At first little is done, so TRUST of the whole plan counts as done in the
        planned time: the estimate begins with the plan and moves from there slowly.
        """
        if not self.plan:
            return "", ""
        if self._stage and name == next(iter(self.plan[0])):  # the run has begun anew
            self._stage, self._start = 0, None
            self._done.clear()
        for index in range(self._stage, len(self.plan)):
            if name in self.plan[index] and self._done[index, name] < 1:
                self._stage = index
                self._done[index, name] = fraction
                break
        planned = [sum(stage.values()) for stage in self.plan]
        present = self.plan[self._stage].items()
        done = sum(planned[: self._stage])
        done += sum(cost * self._done[self._stage, part] for part, cost in present)
        self._start = self._start or (now, done)
        taken, trusted = now - self._start[0], TRUST * sum(planned)
        slowness = (taken + trusted) / (done - self._start[1] + trusted)
        in_all = taken + (sum(planned) - done) * slowness
        number = f"stage {self._stage + 1} of {len(self.plan)}, "
        return number, f", about {_duration(in_all)} in all"

    def over(self, stage: str, items: Iterable[Item], total: int) -> Iterator[Item]:
        """Yield the items of a stage, and report each that is done."""
        for done, item in enumerate(items, start=1):
            yield item
            self.show(stage, done, total)

    def warn(self, text: str) -> None:
        """Print a warning on a line of its own."""
        self.warned.add(text)
        self.tell(f"WARNING: {text}")

    def tell(self, text: str) -> None:
        """Print a line of its own in place of an open one."""
        self._is_open = False
        say(f"\r{text:<{_width()}}" if self._terminal else text, "stderr")

    def close(self) -> None:
        """End an open line, so that nothing else is printed behind it."""
        if self._is_open:
            say("", "stderr")

    def should_stop(self) -> bool:
        """Tell whether Ctrl-C was pressed."""
        return self._should_stop

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        if self._should_stop:
            raise KeyboardInterrupt
        self._should_stop = True
        with suppress(RuntimeError):  # the signal came while a line was being printed
            self.tell("stopping after this step; Ctrl-C again stops at once")


class SilentProgress(ProgressLine):
    """Says nothing; a signal ends the run as with a line."""

    def show(self, stage: str, done: int, total: int) -> None:
        """Say nothing of a step."""

    def tell(self, text: str) -> None:
        """Say nothing, of a warning neither; run.json has it."""


def _width() -> int:
    """Return how many characters of a line that is written over fit on the terminal."""
    with suppress(OSError):  # standard error is none
        return (os.get_terminal_size(2).columns or 80) - 1  # 0: unknown
    return 79


def _duration(seconds: float) -> str:
    """Return a rough duration for people, rounded so that it does not flicker."""
    if seconds < 117:
        return f"{5 * max(1, round(seconds / 5))} s"
    if seconds < 600:
        return f"{round(seconds / 30) / 2:g} min"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
