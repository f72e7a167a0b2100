"""Which frames become keyframes."""

from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import lengths

KEYFRAME_MATCHED_RATIO = 0.2  # below it so little is matched that a new keyframe is needed [-]
# Keyframes of the start without a depth prior, at most: a dynamic object may soon fill the view.
WARM_UP_WITHOUT_PRIOR = 6


def has_warmed_up(graph: KeyframeGraph) -> bool:
    """Tell whether there are enough keyframes for the start."""
    enough = graph.config.warmup_keyframes
    if not graph.keyframes.has_prior:
        enough = min(enough, WARM_UP_WITHOUT_PRIOR)
    return len(graph.keyframes) >= enough


def keyframe_flow(graph: KeyframeGraph) -> float:
    """Return the mean flow that makes a keyframe [px]."""
    config = graph.config
    known = graph.keyframes.has_prior
    flow = config.keyframe_flow if known else config.keyframe_flow_without_prior
    return flow * graph.pixel_scale


def mean_flow(graph: KeyframeGraph, matches: FlowMatches) -> float:
    """Return the mean flow of matches (E = 1), weighted by their confidences [px]."""
    length = lengths(matches.targets - graph.grid.pixels.T)[0]
    confidence = matches.confidences[0, 0]
    return float((confidence * length).sum() / confidence.sum())


def needs_keyframe(
    graph: KeyframeGraph,
    frame: Frame,
    matches: FlowMatches,  # E = 1, newest keyframe to this frame
    is_initialised: bool,
) -> bool:
    """Tell whether a frame should become a keyframe.

    It should if the mean flow is large, if few cells are matched, or if the last keyframe was
    `keyframe_interval` frames ago.
    """
    flow = mean_flow(graph, matches)
    if flow > keyframe_flow(graph):
        return True
    if float(matches.matched_ratios) < KEYFRAME_MATCHED_RATIO:
        return True
    # Without a depth prior the first keyframes need parallax, so a camera at rest makes none.
    may_rest = is_initialised or graph.keyframes.has_prior
    return _is_due(graph, frame) and (may_rest or flow > graph.least_parallax)


def is_redundant(graph: KeyframeGraph, frame: Frame, T_camera_world: Tensor) -> bool:
    """Tell whether a frame with this pose would repeat the newest keyframe.

    Then only dynamic objects made the flow, and two keyframes from one place measure no depth.
    """
    if _is_due(graph, frame):
        return False
    enough = graph.config.cull_fraction * keyframe_flow(graph)
    return graph.distance_to_newest(T_camera_world) < enough


def _is_due(graph: KeyframeGraph, frame: Frame) -> bool:
    elapsed = frame.frame_index - graph.keyframes.frames[-1].frame_index
    return elapsed >= graph.config.keyframe_interval
