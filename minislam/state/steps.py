"""What of a run is done, how long it took, and who is told: reports, interruptions, checkpoints."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from minislam.state.stateful import Stateful

Report = Callable[[str, int, int], None]  # stage, done, of all; KeyboardInterrupt stops the run


def silent(stage: str, done: int, of_all: int) -> None:
    """Report nothing."""


class Steps(Stateful):
    """Counts steps and seconds per stage."""

    seconds: dict[str, float]  # spent per stage
    _done: dict[str, int]  # steps per stage

    def __init__(self, report: Report, keep: Callable[[bool], None]) -> None:
        self.seconds = {}
        self.keep = keep  # a checkpoint, where nothing is half done; True: at all events
        self._report = report
        self._done = {}
        self._stage: str | None = None  # that the time since the last lap is counted for
        self._since = 0.0

    def done(self, stage: str) -> int:
        """Return how many steps of a stage are done."""
        return self._done.get(stage, 0)

    def once(self, stage: str, work: Callable[[], None]) -> None:
        """Do a stage as one step, unless it is done."""
        if not self.done(stage):
            self.keep(True)
            with self.timed(stage):
                work()
            self._done[stage] = 1

    def finish(self, stage: str, done: int, of_all: int) -> None:
        """Report a step after which nothing is half done: from here a run can go on later."""
        self._done[stage] = done
        self._lap(self._stage)
        try:
            self._report(stage, done, of_all)
        except KeyboardInterrupt:
            self.keep(True)
            raise
        self.keep(False)

    def finishing(self, stage: str) -> Callable[[int, int], None]:
        """Return what to call after each step of a stage that can go on later."""
        return lambda done, of_all: self.finish(stage, done, of_all)

    def progress(self, stage: str) -> Callable[[int, int], None]:
        """Return what to call where a stage is in the middle of something."""
        return lambda done, of_all: self._report(stage, done, of_all)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Count the time of what is inside for a stage."""
        self._lap(stage)
        try:
            yield
        finally:
            self._lap(None)

    def _lap(self, next_stage: str | None) -> None:
        """Count the time since the last lap for the stage that it was spent on."""
        now = time.perf_counter()
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = next_stage, now
