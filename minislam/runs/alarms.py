"""Warnings at the time something goes wrong; the summary at the end has the final verdict."""

from minislam.slam import Slam
from minislam.state.steps import Observer
from minislam.tracking.tracker import MIN_MATCHED_RATIO


class Alarms:
    """Says once each time when the camera is lost."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._is_lost = False

    def check(self, slam: Slam) -> None:
        """Look at the newest frame."""
        newest = slam.tracker.tracked[-1:]
        is_lost = any(not tracked.status.is_followed for tracked in newest)
        if is_lost and not self._is_lost:
            is_matched = newest[0].matched_ratio >= MIN_MATCHED_RATIO
            reason = "no motion explains its optical flow" if is_matched else "too little matches"
            self._observer.warn(
                f"frame {newest[0].frame_index}: the camera is lost, {reason}; it is looked for "
                "among the keyframes"
            )
        self._is_lost = is_lost
