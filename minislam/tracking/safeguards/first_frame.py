"""A start that nothing after it can be matched with: a black first frame, a fade-in, a slate."""

from dataclasses import replace

from minislam.records import TrackedFrame, TrackingStatus
from minislam.tracking.keyframe_graph import KeyframeGraph


def forget_start(graph: KeyframeGraph, tracked: list[TrackedFrame], lost_in_a_row: int) -> bool:
    """Forget all keyframes if as many frames were just lost as were followed before.

    Then the frames so far are logged as lost, and the next one can be the first. Only during the
    warm-up, while no keyframe has links.
    """
    if lost_in_a_row < sum(frame.status.is_followed for frame in tracked):
        return False
    while len(graph.keyframes) > 1:
        graph.remove_newest()
    graph.keyframes.remove_newest()
    graph.flow.remove_frame(0)
    tracked[:] = [replace(frame, status=TrackingStatus.LOST) for frame in tracked]
    return True
