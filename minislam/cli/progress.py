"""What a long command shows while it works, and how Ctrl-C ends it between two steps."""

from __future__ import annotations

import signal
import sys
import time
from types import FrameType

PLAIN_STEP = 0.1  # fraction of a stage between two progress lines that are not on a terminal


class ProgressLine:
    """One line per stage with rate and time left; off a terminal, a plain line every 10 %.

    Inside `with`, the first Ctrl-C is deferred to the end of the current step, when the state is
    consistent. A second Ctrl-C ends the program at once.
    """

    def __init__(self) -> None:
        self._begun: dict[str, tuple[float, int]] = {}  # stage: time [s] and steps when first shown
        self._shown: dict[str, float] = {}  # stage: fraction done in the last plain line
        self._terminal = sys.stderr.isatty()
        self._should_stop = False

    def __enter__(self) -> ProgressLine:
        self._handler_before = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *exception: object) -> None:
        signal.signal(signal.SIGINT, self._handler_before)

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
        print(f"{start}WARNING: {text}", file=sys.stderr, flush=True)

    def should_stop(self) -> bool:
        """Tell whether Ctrl-C was pressed."""
        return self._should_stop

    def _print(self, stage: str, text: str, fraction: float) -> None:
        if self._terminal:
            end = "\n" if fraction >= 1 else ""
            print(f"\r\033[K{text}", end=end, file=sys.stderr, flush=True)
        elif fraction >= 1 or fraction >= self._shown.get(stage, 0.0) + PLAIN_STEP:
            self._shown[stage] = fraction
            print(text, file=sys.stderr, flush=True)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._should_stop:
            raise KeyboardInterrupt
        self._should_stop = True
