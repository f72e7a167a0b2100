"""What is said the moment something goes wrong; the summary at the end has the final verdict."""

import os

from minislam.slam import Slam
from minislam.state.steps import Observer
from minislam.tracking.safeguards.diagnostics import is_unexplained


class Alarms:
    """Says once when the camera is lost and when a keyframe contradicts its flow."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._lost = False
        self._judged = -1  # frame of the keyframe that was looked at last

    def check(self, slam: Slam) -> None:
        """Look at the newest frame and at the newest keyframe."""
        tracked, diagnostics = slam.tracker.tracked, slam.tracker.watch.diagnostics
        lost = slam.tracker.initialised and not tracked[-1].status.is_followed
        if lost and not self._lost:
            self._observer.warn(
                f"frame {tracked[-1].frame_index}: the camera is lost; it is looked for among the "
                "keyframes"
            )
        self._lost = lost
        if diagnostics and diagnostics[-1].frame_index > self._judged:
            newest = diagnostics[-1]
            if is_unexplained(newest):
                self._observer.warn(
                    f"frame {newest.frame_index}: the estimated motion explains only "
                    f"{newest.explained:.0%} of the optical flow; the trajectory may break here"
                )
            self._judged = newest.frame_index


def check_finite(slam: Slam) -> None:
    """Raise FloatingPointError at the first NaN or infinity, under MINISLAM_DEBUG=1 only."""
    if not os.environ.get("MINISLAM_DEBUG"):
        return
    keyframes = slam.tracker.keyframes
    parts = {
        "poses": [keyframes.T_camera_world],
        "disparities": [keyframes.disparities],
        "static weights from beta": [keyframes.static_weights],
        "the map": slam.mapper.gaussians.parameters.values(),
    }
    for name, tensors in parts.items():
        for tensor in tensors:
            wrong = int((~tensor.isfinite()).sum())
            if wrong:
                raise FloatingPointError(
                    f"expected finite numbers in {name}, found {wrong} of {tensor.numel()} that "
                    "are not"
                )
