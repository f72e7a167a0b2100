"""Depths by earlier and by later views: equal, changed by a known factor, and not known."""

import math

import pytest
import torch

from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import reproject
from minislam.tracking.safeguards import depth_agreement
from minislam.tracking.safeguards.depth_agreement import depth_difference
from tests.tracking.wall import true_graph


def matched_graph(numbers: list[int]) -> KeyframeGraph:
    """Return keyframes of a wall whose flow is that of the true depths."""
    graph = true_graph(numbers)
    graph.match(neighbourhood_edges(0, len(numbers), 2))
    return graph


def changed(graph: KeyframeGraph, factor: float) -> KeyframeGraph:
    """Make the flow to later keyframes that of depths divided by a factor."""
    for position, (source, target) in enumerate(graph.edges.ends):
        if target > source:
            transforms, disparities, *view = graph.geometry([source], [target])
            positions, _ = reproject(transforms, factor * disparities, *view)
            graph.edges.targets[position] = positions[0].float()
    return graph


def test_depths_of_a_scene_that_stands_still_agree():
    assert depth_difference(matched_graph([0, 3, 6, 9])) < 1e-3


def test_a_known_change_of_the_depths_is_measured():
    graph = changed(matched_graph([0, 3, 6, 9]), 1.1)
    # One Gauss-Newton step: the projection is not linear in the disparity.
    assert depth_difference(graph) == pytest.approx(math.log(1.1), rel=0.1)


def test_only_cells_that_both_sides_see_are_compared():
    graph = changed(matched_graph([0, 3, 6, 9]), 1.1)
    for position, (source, target) in enumerate(graph.edges.ends):
        seen = torch.arange(graph.edges.confidences[position].shape[1]) % 2 == (target > source)
        graph.edges.confidences[position] = graph.edges.confidences[position] * seen
    assert depth_difference(graph) is None


def test_without_views_on_both_sides_nothing_is_known():
    assert depth_difference(true_graph([0, 3])) is None
    assert depth_difference(matched_graph([0, 3])) is None


def test_of_many_keyframes_some_are_compared(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(depth_agreement, "MOST_KEYFRAMES", 2)
    asked, measured = [], depth_agreement._measured

    def noted(graph: KeyframeGraph, positions: list[int]):
        asked.append({graph.edges.ends[p][0] for p in positions})
        return measured(graph, positions)

    monkeypatch.setattr(depth_agreement, "_measured", noted)
    assert depth_difference(matched_graph([0, 3, 6, 9])) < 1e-3
    assert asked == [{2}, {0, 2}]


def test_cells_that_hardly_any_flow_tells_are_not_compared():
    graph, exact = changed(matched_graph([0, 3, 6, 9]), 1.1), matched_graph([0, 3, 6, 9])
    group = torch.arange(len(graph.grid.rays)) % 20
    agree, faint = group < 7, group >= 12  # of the others, which the flow tells well, most agree
    for edge, confidences in enumerate(graph.edges.confidences):
        targets = exact.edges.targets[edge], graph.edges.targets[edge]
        graph.edges.targets[edge] = torch.where(agree, *targets)
        graph.edges.confidences[edge] = torch.where(faint, 0.01 * confidences, confidences)
    assert depth_difference(graph) < 1e-3
