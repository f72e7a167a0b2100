"""What a long command shows while it works, and how a signal ends it between two steps."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

PLAIN_STEP = 0.1  # fraction of a stage between two progress lines that are not on a terminal


# What asks a program to end: Ctrl-C, a scheduler or `docker stop`, a closed terminal (not Windows).
ENDING = ("SIGINT", "SIGTERM", "SIGHUP")


def say(text: str, stream: str = "stdout", end: str = "\n") -> None:
    """Print, but let no reader that ends (`| head`), no full disk, no closed stream end a run."""
    try:
        print(text, end=end, file=getattr(sys, stream), flush=True)
    except (OSError, ValueError):  # ValueError: a closed file
        setattr(sys, stream, open(os.devnull, "w"))


@contextmanager
def ending_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Handle what asks a program to end; what is ignored already (`nohup`) stays so."""
    numbers = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    before = {n: signal.getsignal(n) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


class ProgressLine:
    """One line per stage with rate and time left; off a terminal, a plain line every 10 %.

    The first signal that comes to `interrupt` is deferred to the end of the current step, when
    the state is consistent. A second one ends the program at once.
    """

    def __init__(self) -> None:
        self._begun: dict[str, tuple[float, int]] = {}  # stage: time [s] and steps when first shown
        self._shown: dict[str, float] = {}  # stage: fraction done in the last plain line
        self._terminal = sys.stderr.isatty()
        self._should_stop = False

    def show(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of all steps of a stage are done. Stages may take turns."""
        now = time.perf_counter()
        start, done_at_start = self._begun.setdefault(stage, (now, done))
        seconds, steps = now - start, done - done_at_start
        text = f"{stage}: {done}/{total}"
        if done >= total:
            text += f" ({seconds:.0f} s)"
        elif steps and seconds:
            rate = steps / seconds
            text += f" ({rate:.1f}/s, {(total - done) / rate:.0f} s left)"
        if self._should_stop:
            text += ", stopping after this step; Ctrl-C again stops at once"
        self._print(stage, text, done / max(total, 1))

    def warn(self, text: str) -> None:
        """Print a warning on a line of its own."""
        start = "\r\033[K" if self._terminal else ""
        say(f"{start}WARNING: {text}", "stderr")

    def should_stop(self) -> bool:
        """Tell whether Ctrl-C was pressed."""
        return self._should_stop

    def _print(self, stage: str, text: str, fraction: float) -> None:
        if self._terminal:
            end = "\n" if fraction >= 1 else ""
            say(f"\r\033[K{text}", "stderr", end)
        elif fraction >= 1 or fraction >= self._shown.get(stage, 0.0) + PLAIN_STEP:
            self._shown[stage] = fraction
            say(text, "stderr")

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        if self._should_stop:
            raise KeyboardInterrupt
        self._should_stop = True
