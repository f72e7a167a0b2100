"""Finished steps and seconds per stage; between steps a run is saved and can stop."""

import pytest

from minislam.state.steps import Steps


class Watcher:
    """An observer that asks to stop once a number of steps is shown."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.shown: list[tuple[str, int, int]] = []
        self.stop_after = stop_after

    def show(self, stage: str, done: int, total: int) -> None:
        self.shown.append((stage, done, total))

    def should_stop(self) -> bool:
        return len(self.shown) >= self.stop_after


def test_a_run_is_saved_after_every_step_and_stops_when_asked():
    watcher, saved = Watcher(stop_after=2), []
    steps = Steps(watcher, saved.append)
    steps.finish("walking", 1, 3)
    with pytest.raises(KeyboardInterrupt):
        steps.finish("walking", 2, 3)
    assert saved == [False, True] and steps.done("walking") == 2
    assert watcher.shown == [("walking", 1, 3), ("walking", 2, 3)]


def test_progress_within_a_step_is_shown_and_neither_saves_nor_stops():
    watcher, saved = Watcher(stop_after=1), []
    steps = Steps(watcher, saved.append)
    steps.on_progress("turning")(1, 2)
    assert watcher.shown == [("turning", 1, 2)] and saved == [] and steps.done("turning") == 0


def test_a_stage_of_one_step_is_done_once_and_saved_before_it():
    saved, calls = [], []
    steps = Steps(Watcher(), saved.append)
    for _ in range(2):
        steps.once("turning", lambda: calls.append(list(saved)))
    assert calls == [[True]] and steps.done("turning") == 1 and steps.seconds["turning"] >= 0


def test_a_stage_of_one_step_does_not_begin_after_a_request_to_stop():
    steps = Steps(Watcher(stop_after=0), lambda force: None)
    with pytest.raises(KeyboardInterrupt):
        steps.once("turning", lambda: pytest.fail("began"))


def test_seconds_and_finished_steps_are_the_state():
    steps = Steps(Watcher(), lambda force: None)
    steps.finish("walking", 2, 3)
    other = Steps(Watcher(), lambda force: None)
    other.restore_state(steps.saved_state(), lambda index: None)
    assert other.done("walking") == 2 and other.seconds == steps.seconds


def test_a_stage_goes_on_when_one_inside_it_ends(monkeypatch: pytest.MonkeyPatch):
    # Inside "final adjustment" the last keyframe is mapped; what came after it was not counted.
    moments = iter(range(10))
    monkeypatch.setattr("minislam.state.steps.time.perf_counter", lambda: float(next(moments)))
    steps = Steps(Watcher(), lambda force: None)
    with steps.timed("outer"), steps.timed("inner"):
        pass
    assert steps.seconds == {"outer": 2.0, "inner": 1.0}
