"""Links of the keyframe graph on exact flow: what is linked, and what is confirmed."""

from copy import deepcopy

import pytest
import torch

from minislam.state import memory
from minislam.state.memory import SHELF
from minislam.tracking import frame_graph, keyframe_graph
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import FrameGraph
from tests.tracking.scene import CAMERA
from tests.tracking.wall import TrueFlow, true_graph, true_poses, wall_frame

# What is refused


def test_a_new_link_needs_both_directions():
    flow = TrueFlow(ratios={(0, 3): 0.9, (3, 0): 0.05, (1, 3): 0.5, (3, 1): 0.4})
    graph = true_graph([0, 1, 2, 3], TrackingConfig(), flow)
    asked = [(0, 3), (3, 0), (1, 3), (3, 1)]
    assert graph.filter_confirmed(asked) == [(1, 3), (3, 1)]
    assert graph.filter_confirmed([]) == [] and len(graph.edges) == 0


@pytest.mark.parametrize("is_learned", [False, True])
def test_a_pose_has_the_support_of_the_flow_that_fits_it(
    monkeypatch: pytest.MonkeyPatch, is_learned: bool
):
    graph = true_graph([0, 4], flow=TrueFlow(is_learned=is_learned))
    asked = wall_frame(2), [0, 1], true_poses()[2]
    _, support = graph.fit_pose(*asked)
    match, generator = graph.flow.match, torch.Generator().manual_seed(0)

    def mismatched(*edges):
        matches = match(*edges)
        matches.targets[:] = 60 * torch.rand(matches.targets.shape, generator=generator)
        return matches

    monkeypatch.setattr(graph.flow, "match", mismatched)
    assert graph.fit_pose(*asked)[1] < 0.1 * support
    assert 0.5 < support <= 1


def test_flow_between_the_newest_keyframe_and_its_predecessors_is_measured_both_ways():
    graph = true_graph([0, 1, 2])
    graph.match_composed(2)
    assert graph.edges.ends == [(1, 2), (2, 1), (0, 2), (2, 0)]


def test_after_a_loss_a_keyframe_is_linked_with_what_was_seen_before_it():
    graph = true_graph(list(range(12)))
    graph.flow_to_next[9] = None  # keyframe 10 was relocalised
    for keyframe in range(1, 11):
        graph.match(graph.neighbour_edges(keyframe))
    graph.match([(10, 9), (9, 10)])
    assert graph.neighbour_edges(11) == [(11, 10), (10, 11)]
    assert graph.proximity_edges(11) == [(11, 9), (9, 11), (11, 8), (8, 11)]


def test_many_links_are_measured_in_parts_as_all_at_once(monkeypatch: pytest.MonkeyPatch):
    edges = [(i, j) for i in range(4) for j in range(4) if i != j]
    whole, parted = true_graph([0, 1, 2, 3]), true_graph([0, 1, 2, 3])
    sources, targets = ([edge[end] for edge in edges] for end in (0, 1))
    whole.match(edges)
    parallaxes, confirmed = whole.parallaxes(sources, targets), whole.filter_confirmed(edges)
    given: list[None] = []
    monkeypatch.setattr(frame_graph, "AT_ONCE", 2)
    monkeypatch.setattr(keyframe_graph, "give_back_freed", lambda: given.append(None))
    parted.match(edges)
    assert parted.edges.ends == whole.edges.ends == edges
    pairs = zip(parted.edges.targets, whole.edges.targets, strict=True)
    assert all(a.equal(b) for a, b in pairs)
    assert parted.parallaxes(sources, targets).equal(parallaxes)
    assert parted.filter_confirmed(edges) == confirmed == edges
    assert len(given) >= len(edges) // 2


def test_the_flow_of_links_lies_on_the_shelf_also_when_it_is_restored(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(memory, "SMALLEST", 1)
    graph = true_graph([0, 1, 2])
    graph.match([(0, 1), (1, 0), (1, 2)])
    again = FrameGraph()
    again.restore_state(deepcopy(graph.edges.saved_state()), lambda index: None)
    for edges in (graph.edges, again):
        assert all(map(SHELF.holds, (*edges.targets, *edges.confidences)))
    assert all(a.equal(b) for a, b in zip(again.targets, graph.edges.targets, strict=True))


def test_long_after_the_start_only_keyframes_of_the_horizon_are_looked_at():
    graph = true_graph(list(range(12)), TrackingConfig(window=3))
    assert graph.proximity_edges(11) == [(11, 3), (3, 11)]  # 12 - 3 * 3 = 3 is the first of them


def test_thresholds_in_px_grow_with_the_image():
    small, config = true_graph([0]), TrackingConfig(robust_scale=3.0)
    large = keyframe_graph.KeyframeGraph(CAMERA.resized(640, 480), config, TrueFlow())
    assert large.robust.scale == 2 * 3.0  # px; 320x240 has the scale 1
    for graph in (small, large):
        assert graph.least_parallax == keyframe_graph.MIN_PARALLAX * graph.pixel_scale


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_how_far_a_global_edge_may_reach_is_said_in_px_of_a_reference_image(
    monkeypatch: pytest.MonkeyPatch, ratio: float
):
    graph = true_graph([0, 4])
    distance = ratio * float(graph.distances()[1, 0]) / graph.pixel_scale
    monkeypatch.setattr(keyframe_graph, "GLOBAL_DISTANCE", distance)
    assert bool(graph.global_edges()) == (ratio > 1)


def test_a_keyframe_that_follows_a_loss_has_no_neighbours_before_it():
    graph = true_graph(list(range(4)))
    graph.flow_to_next[2] = None
    assert graph.neighbour_edges(3) == []
