"""What is said the moment something goes wrong; the summary at the end has the final verdict."""

from collections.abc import Iterator

from minislam.slam import Slam
from minislam.tracking.safeguards.diagnostics import is_unexplained


def alarms(slam: Slam) -> Iterator[str]:
    """Yield that the camera is lost since the newest frame, and what contradicts a keyframe."""
    tracked, diagnostics = slam.tracker.tracked, slam.tracker.watch.diagnostics
    followed = [frame.status.is_followed for frame in tracked[-2:]]
    if slam.tracker.initialised and followed == [True, False]:
        yield (
            f"frame {tracked[-1].frame_index}: the camera is lost; it is looked for among the "
            "keyframes"
        )
    if diagnostics and is_unexplained(diagnostics[-1]):
        yield (
            f"frame {diagnostics[-1].frame_index}: the estimated motion explains only "
            f"{diagnostics[-1].explained:.0%} of the optical flow; the trajectory may break here"
        )
