"""What the tracker says about each frame."""

from dataclasses import dataclass
from enum import Enum


class TrackingStatus(Enum):
    """What the tracker knows about one frame."""

    INITIALISING = "initialising"  # followed, but there is no map yet
    OK = "ok"
    RECENTLY_LOST = "recently lost"  # the view is expected back where it was lost
    LOST = "lost"  # the view may come back anywhere

    @property
    def is_followed(self) -> bool:
        """Tell whether the frame gets a pose."""
        return self in (TrackingStatus.INITIALISING, TrackingStatus.OK)


@dataclass(frozen=True)
class TrackedFrame:
    """The tracker's word on one frame."""

    frame_index: int
    timestamp: float  # second
    status: TrackingStatus
    matched_ratio: float  # of the last keyframe, [-]
