"""Progress of a run: finished steps and seconds per stage, reports, checkpoints."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from minislam.state.memory import give_back_freed
from minislam.state.stateful import Stateful


class Observer(Protocol):
    """Shows the progress of a run, and may end it between two steps; by default it does neither."""

    def show(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of the `total` steps of a stage are finished."""
        return None

    def warn(self, text: str) -> None:
        """Tell the user of something at once."""
        return None

    def should_stop(self) -> bool:
        """Tell whether the run should end after the present step."""
        return False


class SilentObserver(Observer):
    """Shows nothing and never ends a run."""


class Steps(Stateful):
    """Counts finished steps and seconds per stage. Between steps a run is saved and can stop."""

    seconds: dict[str, float]  # spent per stage
    _done: dict[str, int]  # steps per stage

    def __init__(self, observer: Observer, save_checkpoint: Callable[[bool], None]) -> None:
        self.seconds = {}
        # Called between steps, when the state is consistent; True saves even if none is due.
        self.save_checkpoint = save_checkpoint
        self._done = {}
        self._observer = observer
        self._stage: str | None = None  # the stage that is being timed
        self._since = 0.0

    def done(self, stage: str) -> int:
        """Return how many steps of a stage are done."""
        return self._done.get(stage, 0)

    def once(self, stage: str, work: Callable[[], None]) -> None:
        """Do a stage that is a single step, unless it is done already."""
        if not self.done(stage):
            self._save_and_stop_if_asked(force=True)
            give_back_freed()
            with self.timed(stage):
                work()
            self._done[stage] = 1

    def finish(self, stage: str, done: int, total: int) -> None:
        """Record that a step is finished. A resumed run begins with the next step."""
        self._done[stage] = done
        self._lap(self._stage)
        self._observer.show(stage, done, total)
        self._save_and_stop_if_asked()

    def on_progress(self, stage: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for progress within a step, where nothing is saved."""
        return lambda done, total: self._observer.show(stage, done, total)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to a stage, then go on with the stage around it, if any."""
        around = self._stage
        self._lap(stage)
        try:
            yield
        finally:
            self._lap(around)

    def _save_and_stop_if_asked(self, force: bool = False) -> None:
        should_stop = self._observer.should_stop()
        self.save_checkpoint(force or should_stop)
        if should_stop:
            raise KeyboardInterrupt

    def _lap(self, next_stage: str | None) -> None:
        """Add the time since the last lap to the stage being timed; then time the next stage."""
        now = time.perf_counter()
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage = next_stage
        self._since = now
