"""What a run says the moment something goes wrong: once each time, and nothing otherwise."""

from types import SimpleNamespace

from minislam.records import TrackedFrame, TrackingStatus
from minislam.runs.warnings import alarms
from minislam.tracking.safeguards.diagnostics import KeyframeDiagnostics


def said(statuses: list[TrackingStatus], explained: dict[int, float | None]) -> list[str]:
    """Return the warnings of a run; `explained` is that of the keyframes, by frame."""
    tracked, diagnostics = [], []
    watch = SimpleNamespace(diagnostics=diagnostics)
    slam = SimpleNamespace(tracker=SimpleNamespace(tracked=tracked, watch=watch, initialised=False))
    texts: dict[str, None] = {}
    for index, status in enumerate(statuses):
        tracked.append(TrackedFrame(index, index / 30, status, 0.5))
        slam.tracker.initialised |= status is TrackingStatus.OK
        if index in explained:
            diagnostics.append(
                KeyframeDiagnostics(index, 0.5, 9.0, explained[index], 0.01, 0.2, 0.9)
            )
        texts |= dict.fromkeys(alarms(slam))  # a text that was said is not said again
    return list(texts)


OK, LOST = TrackingStatus.OK, TrackingStatus.LOST


def test_a_good_run_is_quiet():
    assert said([TrackingStatus.INITIALISING, OK, OK], {0: None, 1: 0.9, 2: 0.7}) == []


def test_a_loss_is_said_once_each_time():
    texts = said([OK, LOST, LOST, OK, LOST], {})
    assert [text.split(":")[0] for text in texts] == ["frame 1", "frame 4"]


def test_nothing_is_looked_for_before_there_is_a_map():
    assert said([TrackingStatus.INITIALISING, LOST, LOST, OK], {}) == []


def test_a_keyframe_that_contradicts_its_flow_is_said_once():
    (text,) = said([OK] * 4, {1: 0.9, 2: 0.3})
    assert text.startswith("frame 2: the estimated motion explains only 30%")
