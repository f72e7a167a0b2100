"""Which frames become keyframes, how many the start takes, and which are redundant."""

from dataclasses import replace

import pytest
import torch

from minislam.geometry import se3_exp
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.config import TrackingConfig
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.keyframe_selection import (
    KEYFRAME_MATCHED_RATIO,
    has_warmed_up,
    is_redundant,
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


def test_a_prior_asks_for_less_flow():
    graph = true_graph([0])
    scale = graph.pixel_scale
    assert keyframe_flow(graph) == CONFIG.keyframe_flow_without_prior * scale
    graph.keyframes.metric_depths[0] = torch.ones(1, 1)
    assert keyframe_flow(graph) == CONFIG.keyframe_flow * scale


def test_much_flow_makes_a_keyframe():
    graph = true_graph([0])
    enough = keyframe_flow(graph)
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


@pytest.mark.parametrize(
    ("asked", "has_prior", "enough"), [(12, True, 12), (12, False, 6), (4, False, 4)]
)
def test_without_a_prior_the_start_takes_few_keyframes(asked: int, has_prior: bool, enough: int):
    graph = true_graph([*range(enough - 1)])
    graph.config = replace(CONFIG, warmup_keyframes=asked)
    graph.keyframes.metric_depths[0] = torch.ones(1, 1) if has_prior else None
    assert not has_warmed_up(graph)
    graph = true_graph([*range(enough)])
    graph.config = replace(CONFIG, warmup_keyframes=asked)
    graph.keyframes.metric_depths[0] = torch.ones(1, 1) if has_prior else None
    assert has_warmed_up(graph)


@pytest.mark.parametrize(("relative", "expected"), [(0.8, True), (1.2, False)])
def test_a_frame_near_the_last_keyframe_is_redundant(relative: float, expected: bool):
    graph = true_graph([0])
    last = graph.keyframes.T_camera_world[-1]
    slide = torch.tensor([0.05, 0, 0, 0, 0, 0], dtype=torch.float64)
    per_slide = graph.distance_to_newest(se3_exp(slide) @ last)
    factor = relative * CONFIG.cull_fraction * keyframe_flow(graph) / per_slide
    pose = se3_exp(factor * slide) @ last
    assert is_redundant(graph, wall_frame(1), pose) is expected
    assert not is_redundant(graph, wall_frame(CONFIG.keyframe_interval), pose)
