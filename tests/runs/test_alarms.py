"""What a run says the moment something goes wrong: once each time, and nothing otherwise."""

from types import SimpleNamespace

from minislam.records import TrackedFrame, TrackingStatus
from minislam.runs.alarms import Alarms


class Said:
    """An observer that remembers its warnings."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def show(self, stage: str, done: int, total: int) -> None:
        pass

    def should_stop(self) -> bool:
        return False

    def warn(self, text: str) -> None:
        self.texts.append(text)


def said(*frames: tuple[TrackingStatus, float]) -> list[str]:
    """Return the warnings of a run from status and matched ratio of its frames."""
    tracked: list[TrackedFrame] = []
    slam = SimpleNamespace(tracker=SimpleNamespace(tracked=tracked))
    observer = Said()
    alarms = Alarms(observer)
    alarms.check(slam)
    for index, frame in enumerate(frames):
        tracked.append(TrackedFrame(index, index / 30, *frame))
        alarms.check(slam)
        alarms.check(slam)  # between steps may come more often than frames
    return observer.texts


BEGUN, OK = (TrackingStatus.INITIALISING, 1.0), (TrackingStatus.OK, 0.6)
RECENTLY, LOST = (TrackingStatus.RECENTLY_LOST, 0.02), (TrackingStatus.LOST, 0.0)
CONTRADICTED = (TrackingStatus.RECENTLY_LOST, 0.5)


def test_a_good_run_is_quiet():
    assert said(BEGUN, OK, OK) == []


def test_a_loss_is_said_once_each_time():
    texts = said(OK, RECENTLY, LOST, OK, RECENTLY)
    assert [text.split(",")[0] for text in texts] == [
        "frame 1: the camera is lost",
        "frame 4: the camera is lost",
    ]


def test_the_reason_is_flow_that_is_not_there_or_flow_that_contradicts():
    assert "too little matches" in said(OK, RECENTLY)[0]
    assert "no motion explains" in said(OK, CONTRADICTED)[0]
