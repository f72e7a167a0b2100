"""Which frames become keyframes: by flow, by matched ratio, by time."""

import torch

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.config import TrackingConfig
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.keyframe_selection import (
    KEYFRAME_MATCHED_RATIO,
    keyframe_flow,
    needs_keyframe,
)
from tests.tracking.wall import GRID, true_graph, wall_frame

CONFIG = TrackingConfig()


def shifted(pixels: float, ratio: float = 1.0) -> FlowMatches:
    targets = GRID.pixels.T[None] + torch.tensor([[pixels], [0.0]])
    return FlowMatches(targets, torch.ones_like(targets), torch.tensor([ratio]))


def needs(
    graph: KeyframeGraph,
    frame: int,
    matches: FlowMatches,
    before: FlowMatches | None = None,
    initialised: bool = True,
) -> bool:
    """Tell it; without a flow before, the camera has hardly moved since the frame before."""
    last = wall_frame(frame - 1), before or matches
    return needs_keyframe(graph, wall_frame(frame), matches, last, initialised)


def test_a_prior_asks_for_less_flow_once_the_start_is_over():
    graph = true_graph([0])
    wide = CONFIG.keyframe_flow_without_prior * graph.pixel_scale
    assert keyframe_flow(graph, True) == keyframe_flow(graph, False) == wide
    graph.keyframes.prior_disparities[0, 3] = 1.0
    assert keyframe_flow(graph, True) == CONFIG.keyframe_flow * graph.pixel_scale
    assert keyframe_flow(graph, False) == wide


def test_much_flow_makes_a_keyframe():
    graph = true_graph([0])
    enough = keyframe_flow(graph, True)
    assert needs(graph, 1, shifted(1.01 * enough)) and not needs(graph, 1, shifted(0.99 * enough))


def test_without_a_prior_the_frame_nearest_to_the_flow_is_the_keyframe():
    graph = true_graph([0])
    enough = keyframe_flow(graph, True)
    near, next_one = shifted(0.79 * enough), shifted(1.19 * enough)  # .21 before it, .19 beyond
    assert not needs(graph, 2, near, before=shifted(0.39 * enough))
    assert needs(graph, 2, shifted(0.81 * enough), before=shifted(0.41 * enough))
    assert needs(graph, 3, next_one, before=near)
    back = shifted(0.99 * enough)  # the camera turns back: the next frame will not be beyond
    assert not needs(graph, 3, back, before=next_one)
    # The first frame after a keyframe is one whole step away from it.
    frame = wall_frame(1)
    assert needs_keyframe(graph, frame, shifted(0.67 * enough), None, True)
    assert not needs_keyframe(graph, frame, shifted(0.66 * enough), None, True)
    graph.keyframes.prior_disparities[0, 3] = 1.0
    enough = keyframe_flow(graph, True)
    assert not needs_keyframe(graph, frame, shifted(0.99 * enough), None, True)


def test_few_matches_make_a_keyframe():
    graph = true_graph([0])
    assert needs(graph, 1, shifted(0.0, ratio=0.9 * KEYFRAME_MATCHED_RATIO))
    assert not needs(graph, 1, shifted(0.0, ratio=1.1 * KEYFRAME_MATCHED_RATIO))


def test_time_makes_a_keyframe_unless_the_start_needs_parallax():
    graph, last = true_graph([0]), CONFIG.keyframe_interval
    assert needs(graph, last, shifted(0.0)) and not needs(graph, last - 1, shifted(0.0))
    least = graph.least_parallax
    assert not needs(graph, last, shifted(0.99 * least), initialised=False)
    assert needs(graph, last, shifted(1.01 * least), initialised=False)
    assert not needs(graph, last - 1, shifted(1.01 * least), initialised=False)
