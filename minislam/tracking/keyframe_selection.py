"""Which frames become keyframes."""

from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import lengths

KEYFRAME_MATCHED_RATIO = 0.2  # a frame in which less is matched becomes a keyframe [-]


def keyframe_flow(graph: KeyframeGraph, is_initialised: bool) -> float:
    """Return the mean flow that makes a keyframe [px].

    The start needs parallax even with a depth prior: over short baselines a large dynamic object
    fits the motion of the camera as well as the room does.
    """
    config, may_be_near = graph.config, is_initialised and graph.keyframes.has_prior
    flow = config.keyframe_flow if may_be_near else config.keyframe_flow_without_prior
    return flow * graph.pixel_scale


def mean_flow(graph: KeyframeGraph, matches: FlowMatches) -> float:
    """Return the mean flow of matches (E = 1), weighted by their confidences in u [px]."""
    length = lengths(matches.targets - graph.grid.pixels.T)[0]
    confidence = matches.confidences[0, 0]
    return float((confidence * length).sum() / confidence.sum())


def needs_keyframe(
    graph: KeyframeGraph,
    frame: Frame,
    matches: FlowMatches,  # E = 1, newest keyframe to this frame
    before: tuple[Frame, FlowMatches] | None,  # of the frame before; None: the keyframe
    is_initialised: bool,
) -> bool:
    """Tell whether a frame moved far, is hardly matched, or is `keyframe_interval` frames away.

    Without a depth prior each keyframe takes its scale from the one before, and drifts over wide
    steps. So the frame whose mean flow is nearest to the threshold is taken, not the first beyond
    it: the next one is expected to move as far as this one did.
    """
    flow, threshold = mean_flow(graph, matches), keyframe_flow(graph, is_initialised)
    if not graph.keyframes.has_prior:
        step = flow - mean_flow(graph, before[1]) if before else flow
        threshold -= step / 2
    if flow > threshold or float(matches.matched_ratios) < KEYFRAME_MATCHED_RATIO:
        return True
    # Without a depth prior the first keyframes need motion, so a camera at rest makes none.
    may_rest = is_initialised or graph.keyframes.has_prior
    due = graph.keyframes.frames[-1].frame_index + graph.config.keyframe_interval
    return frame.frame_index >= due and (may_rest or flow > graph.least_parallax)
