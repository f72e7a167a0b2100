"""The frame graph: flow on its edges, distances between keyframes, choice of pairs."""

import pytest
import torch
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.tracking import frame_graph
from minislam.tracking.frame_graph import (
    FAR,
    FrameGraph,
    both_directions,
    flow_distances,
    neighbourhood_edges,
    proximity_pairs,
)
from minislam.tracking.grid import Grid
from tests.helpers import random_transforms
from tests.tracking import golden
from tests.tracking.scene import CAMERA, PIXELS, RAYS, STRIDE, poses_on_an_arc, uniform

GRID = Grid.of(CAMERA, STRIDE)


def matches_of(value: float, edges: int, ratio: float = 1.0) -> FlowMatches:
    targets = torch.full((edges, 2, len(RAYS)), value)
    return FlowMatches(targets, torch.ones_like(targets), torch.full((edges,), ratio))


def distances_on_a_line(count: int) -> Tensor:
    """Return |i - j|: the distances of a camera that moves steadily on a line."""
    places = torch.arange(count, dtype=torch.float64)
    return (places[:, None] - places).abs()


# The edges


def test_recording_an_edge_again_replaces_its_matches():
    graph = FrameGraph()
    graph.record([(0, 1), (1, 0)], matches_of(1.0, 2))
    graph.record([(1, 0), (0, 2)], matches_of(2.0, 2))
    assert graph.ends == [(0, 1), (1, 0), (0, 2)] and len(graph) == 3
    assert [float(t[0, 0]) for t in graph.targets] == [1.0, 2.0, 2.0]
    assert graph.targets[0].shape == graph.confidences[0].shape == (2, len(RAYS))


def test_an_edge_keeps_what_it_has_against_clearly_less():
    graph = FrameGraph()
    graph.record([(0, 1)], matches_of(1.0, 1, ratio=0.5))
    graph.record([(0, 1)], matches_of(2.0, 1, ratio=0.39))
    assert float(graph.targets[0][0, 0]) == 1.0  # 0.39 < 0.8 * 0.5
    graph.record([(0, 1)], matches_of(3.0, 1, ratio=0.41))
    assert float(graph.targets[0][0, 0]) == 3.0
    graph.record([(0, 1)], matches_of(4.0, 1, ratio=0.35))
    assert float(graph.targets[0][0, 0]) == 4.0 and len(graph) == 1  # 0.35 > 0.8 * 0.41


def test_recorded_targets_keep_the_order_of_cells():
    graph = FrameGraph()
    targets = GRID.pixels.T[None]
    graph.record([(0, 1)], FlowMatches(targets, torch.ones_like(targets), torch.ones(1)))
    assert torch.equal(graph.targets[0], GRID.pixels.T)


def test_edges_need_as_many_matches():
    with pytest.raises(ValueError):
        FrameGraph().record([(0, 1), (1, 0)], matches_of(1.0, 1))


def test_neighbourhood_by_hand():
    assert neighbourhood_edges(2, 4, 2) == [
        (2, 0), (0, 2), (2, 1), (1, 2), (3, 1), (1, 3), (3, 2), (2, 3),
    ]  # fmt: skip
    assert neighbourhood_edges(0, 1, 3) == []


# Distances


@pytest.mark.parametrize(
    ("full_flow_weight", "name"), [(0.75, "dist_oneway_b75"), (0.25, "dist_oneway_b25")]
)
def test_distances_are_the_official_ones(full_flow_weight: float, name: str):
    # In cells there, in px here: the cells of the stored problem are px of its camera. In all of
    # its pairs most cells are in view, so the minimal fraction (0.75 there) plays no part.
    state, camera = golden.state(), golden.camera()
    pixels = golden.pixels()
    actual = flow_distances(
        state.T_camera_world,
        state.disparities,
        camera.rays(pixels),
        pixels,
        camera,
        full_flow_weight,
    )
    one_way = golden.golden()[name]
    expected = 0.5 * (one_way + one_way.T)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-10)


def test_a_pair_that_hardly_sees_the_same_is_far(monkeypatch):
    # With the official fraction of 0.75 the stored pose is far; ours tolerates more.
    state, camera = golden.state(), golden.camera()
    pixels = golden.pixels()
    poses = state.T_camera_world.clone()
    poses[5] = golden.transforms_of(golden.golden()["dist_far_poses5"])
    monkeypatch.setattr(frame_graph, "MIN_VALID_FRACTION", 0.75)
    actual = flow_distances(poses, state.disparities, camera.rays(pixels), pixels, camera, 0.75)
    assert actual[0, 5] == FAR  # one way at least; the official code has 1000 px
    assert actual[:5, :5].max() < 100


def test_distance_by_hand():
    # Sideways by 0.5 at disparity 0.4 with fx = 60 px: 12 px with and without rotation.
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = -0.5
    disparities = torch.full((2, len(RAYS)), 0.4, dtype=torch.float64)
    distance = flow_distances(poses, disparities, RAYS, PIXELS, CAMERA, 0.75)
    expected = torch.tensor([[0.0, 12.0], [12.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-12)


def test_a_pure_rotation_counts_by_its_share():
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, :3] = random_transforms(1, "tiny", 0)[0, :3, :3]
    poses[1, 0, 2], poses[1, 2, 0] = 0.05, -0.05
    disparities = 0.2 + 0.3 * uniform(0, 2, len(RAYS))
    whole, none, some = (
        flow_distances(poses, disparities, RAYS, PIXELS, CAMERA, weight)[0, 1]
        for weight in (1.0, 0.0, 0.75)
    )
    assert none < 1e-12 < 1 < whole
    torch.testing.assert_close(some, 0.75 * whole)


def test_distances_within_a_limit_are_those_without_one():
    poses = poses_on_an_arc(6, 3)
    disparities = 0.2 + 0.3 * uniform(4, 6, len(RAYS))
    view = poses, disparities, RAYS, PIXELS, CAMERA, 0.75
    whole = flow_distances(*view)
    limit = float(whole[0, 2])
    limited = flow_distances(*view, limit=limit)
    assert torch.equal(limited[whole <= limit], whole[whole <= limit])
    assert int((limited == FAR).sum()) > int((whole == FAR).sum())
    for rows in (range(3, 4), range(0, 6, 2), range(1, 6, 3)):
        some, chosen = flow_distances(*view, rows=rows), list(rows)
        assert torch.equal(some[chosen], whole[chosen])
        assert torch.equal(some[:, chosen], whole[:, chosen])


def test_distances_are_symmetric_and_zero_to_oneself():
    poses, disparities = poses_on_an_arc(4, 0), 0.2 + 0.3 * uniform(0, 4, len(RAYS))
    distance = flow_distances(poses, disparities, RAYS, PIXELS, CAMERA, 0.75)
    assert torch.equal(distance, distance.T)
    assert distance.diagonal().max() < 1e-10


# Choice of pairs


@pytest.mark.parametrize("existing", [False, True])
def test_pairs_are_the_official_ones(existing: bool):
    # The official front-end at its 30th keyframe: threshold 16 (cells there), suppression 1, pairs
    # of the newest 5 keyframes with the newest 25. It lists the three predecessors of each first;
    # around these it suppresses nothing, so here they are set aside by their distance.
    official = golden.golden()
    distances = official["es_D"][:30, :30].clone()
    forced = neighbourhood_edges(25, 30, 3)
    for i, j in forced:
        distances[i, j] = torch.inf
    distances[:, :5] = torch.inf
    name = "es_front_t30_with_existing" if existing else "es_front_t30"
    taken = [tuple(edge) for edge in official["es_front_pre"].tolist()] if existing else []
    pairs = proximity_pairs(
        distances, taken, range(25, 30), 16.0, limit_per_keyframe=40, suppression=1
    )
    expected = [tuple(edge) for edge in official[name].tolist()]
    assert pairs and both_directions(pairs) == [edge for edge in expected if edge not in forced]


def test_near_pairs_come_first_and_suppress_their_like():
    distances = distances_on_a_line(12)
    distances[11, 3], distances[11, 4], distances[11, 2], distances[11, 7] = 0.1, 0.2, 0.3, 0.4
    pairs = proximity_pairs(distances, [], range(11, 12), 0.5, limit_per_keyframe=9, suppression=2)
    assert pairs == [(11, 3), (11, 7)]  # 4 and 2 are within 2 of 3
    every = proximity_pairs(distances, [], range(11, 12), 0.5, limit_per_keyframe=9, suppression=0)
    assert every == [(11, 3), (11, 4), (11, 2), (11, 7)]


def test_existing_edges_suppress_in_either_direction():
    distances = distances_on_a_line(12)
    distances[11, 3], distances[11, 7] = 0.1, 0.4
    for taken in ([(10, 4)], [(4, 10)]):
        pairs = proximity_pairs(distances, taken, range(11, 12), 0.5, limit_per_keyframe=9)
        assert pairs == [(11, 7)]


def test_a_pair_two_apart_suppresses_nothing_but_itself():
    distances = distances_on_a_line(6)
    distances[5, 3], distances[5, 2], distances[5, 4] = 0.1, 0.2, 0.3
    pairs = proximity_pairs(distances, [(5, 3)], range(5, 6), 0.5, limit_per_keyframe=9)
    assert pairs == [(5, 2), (5, 4)]


def test_no_keyframe_gets_more_than_its_share_of_pairs():
    distances = 0.01 * distances_on_a_line(12)
    pairs = proximity_pairs(distances, [], range(12), 1.0, limit_per_keyframe=2, suppression=0)
    counts = [sum(i == newer for i, _ in pairs) for newer in range(12)]
    assert counts == [0, 1] + [2] * 10
    assert all(j < i for i, j in pairs) and len(set(pairs)) == len(pairs)


def test_pairs_that_are_too_far_are_left_out():
    distances = 10 * distances_on_a_line(5)
    assert proximity_pairs(distances, [], range(5), 9.0, limit_per_keyframe=5) == []
    assert proximity_pairs(distances[:1, :1], [], range(1), 9.0, limit_per_keyframe=5) == []
