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


def needs(graph: KeyframeGraph, frame: int, matches: FlowMatches, initialised: bool = True) -> bool:
    return needs_keyframe(graph, wall_frame(frame), matches, initialised)


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


def test_few_matches_make_a_keyframe():
    graph = true_graph([0])
    assert needs(graph, 1, shifted(0.0, ratio=0.9 * KEYFRAME_MATCHED_RATIO))
    assert not needs(graph, 1, shifted(0.0, ratio=1.1 * KEYFRAME_MATCHED_RATIO))


def test_time_makes_a_keyframe_unless_the_start_needs_parallax():
    graph, last = true_graph([0]), CONFIG.keyframe_interval
    assert needs(graph, last, shifted(0.0)) and not needs(graph, last - 1, shifted(0.0))
    least = CONFIG.min_parallax * graph.pixel_scale
    assert not needs(graph, last, shifted(0.99 * least), initialised=False)
    assert needs(graph, last, shifted(1.01 * least), initialised=False)
    assert not needs(graph, last - 1, shifted(1.01 * least), initialised=False)
