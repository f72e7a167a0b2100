"""Which frame the warm-up begins with, and when it is over.

Nothing can be followed from a black first frame, a slate, or the short side of a jump cut. So the
warm-up begins anew behind the last followed frame as soon as it has lost as many frames as it has
followed. Once it is over, tracking goes on to the end of the film. Then it begins anew there, too,
if it has lost more frames than it has followed, or if it has lost some and cannot tell depth. If
the later start is worth less, the best start is repeated.
"""

from dataclasses import replace

from minislam.records import TrackingStatus
from minislam.state.stateful import Stateful
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.keyframe_selection import mean_flow
from minislam.tracking.tracker import Tracker

Worth = tuple[bool, int]  # whether a start can tell depth; the frames that it followed


class FirstFrame(Stateful):
    """Chooses the first frame of the warm-up, and by that the frame that is tracked next."""

    best: int = 0  # first frame of the best start that was given up
    worth: Worth = (False, 0)  # of the best start
    is_chosen: bool = False  # all starts were tried: frames that are lost later change nothing

    def next_frame(self, tracker: Tracker, count: int) -> int | None:
        """Return which of `count` frames the tracker shall see next, None after the last."""
        tracked, is_over = tracker.tracked, len(tracker.tracked) == count
        is_open = (is_over or not tracker.initialised) and not self.is_chosen
        if len(tracker.keyframes) and is_open:
            start = tracker.keyframes.frames[0].frame_index
            followed = [t.frame_index for t in tracked[start:] if t.status.is_followed]
            worth, lost = (can_tell_depth(tracker), len(followed)), len(tracked) - 1 - followed[-1]
            as_many = lost >= len(followed) and not tracker.initialised
            # Behind the last frame, the lost ones are tried if they may be worth more.
            if lost and (as_many or (is_over and (True, lost) > worth)):
                if worth > self.worth:
                    self.best, self.worth = start, worth
                begin_anew(tracker, followed[-1] + 1)
            elif is_over and worth < self.worth:
                self.is_chosen = True
                begin_anew(tracker, self.best)
        if len(tracked) < count:
            return len(tracked)
        self.is_chosen = True
        return None


def has_warmed_up(tracker: Tracker) -> bool:
    """Tell whether the warm-up has its keyframes: few, as motion is remembered only after it."""
    return len(tracker.keyframes) >= tracker.config.warmup_keyframes


def can_tell_depth(tracker: Tracker) -> bool:
    """Tell whether depth may be known: by a prior, or from a mean flow of `least_parallax`."""
    graph = tracker.graph
    seen = [*graph.flow_to_next, *(tracker.last_non_keyframe or ())[1:]]
    lengths = (mean_flow(graph, flow) for flow in seen if flow is not None)
    return graph.keyframes.has_prior or any(px >= graph.least_parallax for px in lengths)


def begin_anew(tracker: Tracker, first: int) -> None:
    """Forget all keyframes: frames before `first` have no pose, it comes next."""
    before, tracked = tracker.graph, tracker.tracked
    for keyframe in range(len(before.keyframes)):
        before.flow.remove_frame(keyframe)
    tracker.begin_with(KeyframeGraph(*before.given))
    tracker.graph.seeks_focal = before.seeks_focal
    del tracked[first:]
    for index, frame in enumerate(tracked):
        if frame.status.is_followed:
            tracked[index] = replace(frame, status=TrackingStatus.GIVEN_UP)
