"""What a long command shows while it works, and how Ctrl-C ends it between two steps."""

from __future__ import annotations

import signal
import sys
import time
from types import FrameType

PLAIN_STEP = 0.1  # share of a stage between two progress lines that are not on a terminal


class ProgressLine:
    """One line per stage with rate and time left; off a terminal, a plain line every 10 %."""

    def __init__(self) -> None:
        self._begun: dict[str, tuple[float, int]] = {}  # stage: time [s] and steps when first shown
        self._shown: dict[str, float] = {}  # stage: share done in the last plain line
        self._terminal = sys.stderr.isatty()

    def show(self, stage: str, done: int, of_all: int) -> None:
        """Report that `done` of all steps of a stage are done. Stages may take turns."""
        now = time.perf_counter()
        start, done_at_start = self._begun.setdefault(stage, (now, done))
        seconds, steps = now - start, done - done_at_start
        text = f"{stage}: {done}/{of_all}"
        if done >= of_all:
            text += f" ({seconds:.0f} s)"
        elif steps and seconds:
            rate = steps / seconds
            text += f" ({rate:.1f}/s, {(of_all - done) / rate:.0f} s left)"
        self._print(stage, text, done / max(of_all, 1))

    def _print(self, stage: str, text: str, share: float) -> None:
        if self._terminal:
            end = "\n" if share >= 1 else ""
            print(f"\r\033[K{text}", end=end, file=sys.stderr, flush=True)
        elif share >= 1 or share >= self._shown.get(stage, 0.0) + PLAIN_STEP:
            self._shown[stage] = share
            print(text, file=sys.stderr, flush=True)


class StopRequest:
    """Remembers Ctrl-C until `check`: in the middle of a step half of the state would be old.

    A second Ctrl-C does not wait.
    """

    def __init__(self) -> None:
        self._requested = False

    def __enter__(self) -> StopRequest:
        self._before = signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *exception: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def check(self) -> None:
        """Stop here if it has been asked for."""
        if self._requested:
            raise KeyboardInterrupt

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
