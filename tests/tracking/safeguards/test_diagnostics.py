"""What the edges of a keyframe say about it, and where a trajectory is broken."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from minislam.geometry import se3_exp
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust
from minislam.tracking.safeguards import diagnostics
from minislam.tracking.safeguards.diagnostics import (
    Break,
    KeyframeDiagnostics,
    Watch,
    continuity,
    diagnose,
    find_breaks,
    is_unexplained,
    weight_so_far,
)
from minislam.tracking.safeguards.motion_memory import judge_all
from tests.tracking.scene import normal
from tests.tracking.wall import CAMERA, GRID, true_graph

HEALTHY, WEAK, FAINT, FIRM, UNEXPLAINED, DEEP, UNTIED, NEW, LOOSE = (
    (0.97, 0.02, 0.2, 0.9, 0.04),
    (0.8, 0.02, 0.2, 0.9),
    (0.8, 0.02, 0.2, 0.9, 0.04),
    (0.8, 0.02, 0.2, 0.9, 0.02),
    (0.4, 0.02, 0.2, 0.9),
    (0.97, 0.5, 0.2, 0.9),
    (0.97, 0.02, 0.003, None),
    (0.97, 0.02, 0.2, 0.4),
    (0.97, 0.02, 0.2, 0.9, 0.13),
)  # explained flow, depth error, continuity, agreement, deviation of the scale


def keyframes(*kinds: tuple[float | None, ...]) -> list[KeyframeDiagnostics]:
    """Return diagnostics of keyframes at frames 0, 10, 20, ..."""
    return [KeyframeDiagnostics(10 * k, 0.9, 30.0, *kind) for k, kind in enumerate(kinds)]


def test_at_the_truth_all_is_matched_explained_and_of_one_depth():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    found = diagnose(graph, 2)
    assert found.frame_index == 2 and found.matched_ratio == 1
    assert found.parallax > 3
    assert found.explained == 1
    assert found.depth_error < 1e-3


def test_a_wrong_pose_does_not_explain_the_flow():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    turn = se3_exp(torch.tensor([0, 0, 0, 0.05, 0.1, 0], dtype=torch.float64))
    graph.keyframes.T_camera_world[2] = turn @ graph.keyframes.T_camera_world[2]
    assert diagnose(graph, 2).explained < 0.1
    assert diagnose(graph, 1).explained == 1  # judged by keyframes before it


def test_what_contradicts_a_pose_counts_although_the_memory_takes_it_for_motion():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    contradicts = GRID.pixels[:, 0] < 0.7 * CAMERA.width
    last = [p for p, edge in enumerate(graph.edges.ends) if edge[1] == 2]
    for targets in [*(graph.edges.targets[p] for p in last), graph.flow_to_next[1].targets[0]]:
        targets[:, contradicts] += 8  # px
    graph.config = replace(graph.config, motion_memory=0.5 / graph.pixel_scale)
    judge_all(graph)
    assert graph.keyframes.cell_weights[1, contradicts].mean() < 0.3  # excluded from now on
    assert diagnose(graph, 2).explained == pytest.approx(0.3, abs=0.1)
    assert diagnose(graph, 1).explained == 1


def test_what_was_known_to_move_need_not_be_explained():
    graph = true_graph([0, 1, 2])
    graph.match(neighbourhood_edges(0, 3, 2))
    keyframes, (height, width) = graph.keyframes, graph.grid.shape
    moving = torch.zeros(height, width, dtype=torch.bool)
    moving[:, : width // 2] = True
    keyframes.disparities[:, moving.flatten()] *= 3  # so that its flow contradicts all poses
    assert diagnose(graph, 2).explained < 0.9
    keyframes.static_weights[:, moving.flatten()] = 0
    assert diagnose(graph, 2).explained == 1
    keyframes.static_weights[:] = 1
    keyframes.motion_weights[0] = 1 - moving.flatten().float()
    assert weight_so_far(graph, 1).reshape(height, width)[:, : width // 2 - 1].max() == 0
    keyframes.overlay = torch.zeros_like(keyframes.disparities[0])
    assert weight_so_far(graph, 2).max() == 0


def test_what_holds_a_keyframe_is_known_from_those_before():
    graph = true_graph([0, 1, 2, 3])
    graph.match(neighbourhood_edges(0, 4, 3))
    assert continuity(graph, 0) == continuity(graph, 1) == (None, None)  # nothing before it
    held, agreement = continuity(graph, 3)
    assert agreement == 1 and held == pytest.approx(1, abs=0.05)
    for source in range(3):  # a fast turn: little is matched, but all of it is known
        graph.edges.confidences[graph.edges.ends.index((source, 3))] *= 0.1
    assert continuity(graph, 3) == (pytest.approx(held), 1)
    held, _ = continuity(graph, 3)
    graph.edges.confidences[graph.edges.ends.index((0, 3))][:] = 0  # the best edge counts
    assert continuity(graph, 3) == (held, 1)
    graph.keyframes.motion_weights[:] = 0.5
    graph.keyframes.static_weights[:, ::2] = 0
    assert continuity(graph, 3)[0] == pytest.approx(held / 4, rel=0.1)
    graph.keyframes.static_weights *= 0.02  # nothing is confirmed
    assert continuity(graph, 3)[0] == pytest.approx(held / 4, rel=0.1)
    graph.flow_to_next[1] = None  # the camera was lost
    assert continuity(graph, 2) == continuity(graph, 3) == (None, None)


@pytest.mark.parametrize(("cells", "agreement"), [(1, 1), (3, 0)])
def test_one_cell_does_not_tell_what_a_keyframe_agrees_with(cells: int, agreement: int):
    graph = true_graph([0, 1, 2, 3])
    graph.match(neighbourhood_edges(0, 4, 3))
    edge = graph.edges.ends.index((0, 3))
    certain = graph.edges.confidences[edge][0].topk(cells).indices
    graph.edges.confidences[edge][:] = 0
    graph.edges.confidences[edge][:, certain] = 1
    graph.edges.targets[edge][0, certain] += 9  # px
    assert continuity(graph, 3)[1] == agreement


def test_a_dynamic_object_in_place_of_the_scene_is_new():
    graph = true_graph([0, 1, 2, 3])
    graph.match(neighbourhood_edges(0, 4, 3))
    before, _ = continuity(graph, 3)
    rest = GRID.pixels[:, 0] > 0.75 * CAMERA.width
    confidences = dict(zip(graph.edges.ends, graph.edges.confidences, strict=True))
    targets = dict(zip(graph.edges.ends, graph.edges.targets, strict=True))
    for source in (0, 1):
        confidences[source, 3][:, ~rest] = 0  # behind it
        targets[source, 3][0, rest] += 9  # px: the pose follows it, not what is left of the scene
    seen = graph.flow_to_next[1]
    seen.confidences[0, :, ~rest] = 0
    targets[2, 3][0, rest] += 9
    held, agreement = continuity(graph, 3)
    assert held < 0.2 * before and agreement == 0
    assert continuity(graph, 2)[1] == 1


def test_a_keyframe_of_another_scale_sees_other_depths():
    graph = true_graph([0, 0])  # from one place the flow says nothing about depth
    graph.match(neighbourhood_edges(0, 2, 1))
    graph.keyframes.disparities[1] *= 1.5
    found = diagnose(graph, 1)
    assert found.explained == 1
    assert found.depth_error == pytest.approx(math.log(1.5), rel=1e-3)


def test_how_far_the_sky_is_breaks_nothing():
    graph = true_graph([0, 0])
    graph.match(neighbourhood_edges(0, 2, 1))
    sky = GRID.pixels[:, 1] < 0.6 * CAMERA.height
    graph.keyframes.disparities[:, sky] = torch.tensor([[0.001], [0.003]])
    assert diagnose(graph, 1).depth_error < 1e-3


def test_only_a_camera_at_rest_may_see_other_depths():
    for places, breaks in (([0, 0], []), ([0, 1, 1], [Break(1, 1)])):
        graph = true_graph(places)
        last = len(places) - 1
        graph.match(neighbourhood_edges(0, len(places), 1))
        graph.keyframes.disparities[last] *= 1.5
        watch = Watch(graph)
        watch.conclude()
        assert watch.diagnostics[last].depth_error > 0.3 and watch.breaks == breaks
    graph = true_graph([0, 0])
    graph.match(neighbourhood_edges(0, 2, 1))
    turn = se3_exp(torch.tensor([0, 0, 0, 0.05, 0.1, 0], dtype=torch.float64))
    graph.keyframes.T_camera_world[1] = turn @ graph.keyframes.T_camera_world[1]
    watch = Watch(graph)
    watch.conclude()  # but its flow must fit
    assert watch.diagnostics[1].parallax == 0 and watch.breaks == [Break(0, 0)]


@pytest.mark.parametrize(("parallax", "breaks"), [(0.1, []), (30.0, [Break(10, 10)])])
def test_what_holds_a_camera_at_rest_may_change(monkeypatch, parallax: float, breaks: list):
    told = [replace(k, parallax=parallax) for k in keyframes(HEALTHY, UNTIED, HEALTHY)]
    monkeypatch.setattr(diagnostics, "diagnose", lambda graph, keyframe: told[keyframe])
    watch = Watch(true_graph([0, 0, 0]))
    watch.conclude()
    assert watch.breaks == breaks


def test_a_turning_camera_has_no_parallax_and_keeps_its_disparities():
    graph = true_graph([0, 1, 2], TrackingConfig(robust_scale=0))
    poses = graph.keyframes.T_camera_world
    poses[2] = se3_exp(torch.tensor([0, 0, 0, 0.01, 0.02, 0], dtype=torch.float64)) @ poses[1]
    graph.match([(2, 1), (1, 2)])
    assert diagnose(graph, 2).parallax < 0.1
    before = graph.keyframes.disparities.clone()
    adjust(graph, first_free=2, iterations=3)
    assert torch.equal(graph.keyframes.disparities, before)


def test_a_keyframe_without_links_is_reported_as_such():
    found = diagnose(true_graph([0, 1]), 1)
    assert found.matched_ratio == 0 and found.parallax == 0
    assert found.explained is None and found.depth_error is None
    assert find_breaks([found]) == [] and not is_unexplained(found)


@pytest.mark.parametrize(
    ("kinds", "breaks"),
    [
        ([HEALTHY] * 4, []),
        ([HEALTHY, HEALTHY, UNEXPLAINED, HEALTHY], [Break(20, 20)]),
        ([HEALTHY, DEEP, HEALTHY, UNEXPLAINED, HEALTHY], [Break(10, 30)]),
        ([UNEXPLAINED, *[HEALTHY] * 4, DEEP], [Break(0, 0), Break(50, 50)]),
        ([HEALTHY, (None,) * 4, HEALTHY], []),
        ([HEALTHY, UNTIED, HEALTHY, NEW, HEALTHY], [Break(10, 30)]),
        ([HEALTHY, LOOSE, HEALTHY], [Break(10, 10)]),
        ([HEALTHY, WEAK, WEAK, HEALTHY], []),
        ([HEALTHY, WEAK, WEAK, WEAK, WEAK, HEALTHY], [Break(10, 40)]),
        ([HEALTHY, WEAK, UNEXPLAINED, WEAK, HEALTHY], [Break(10, 30)]),
        ([HEALTHY, (0.97, 0.02, 0.2, 0.48)], []),
        ([FAINT] * 3, [Break(0, 20)]),
        ([FAINT, FIRM, FAINT, FAINT], []),  # wide photos
        ([HEALTHY, DEEP, HEALTHY, WEAK, WEAK, WEAK], [Break(10, 50)]),
    ],
)
def test_breaks_are_runs_of_broken_keyframes(kinds: list, breaks: list[Break]):
    assert find_breaks(keyframes(*kinds)) == breaks


def walk_tied_by(cells: int) -> KeyframeGraph:
    """Return a walk between whose halves, up to keyframe 4 and from it on, so many cells match."""
    graph = true_graph(range(10))
    graph.match(neighbourhood_edges(0, 10, 2))
    few, edges = torch.arange(len(GRID.rays)) < cells, graph.edges
    for position, (source, target) in enumerate(edges.ends):
        edges.targets[position] = (
            edges.targets[position] + 0.3 * normal(position, 2, len(few)).float()
        )
        if (source < 5) != (target < 5):
            edges.confidences[position] = edges.confidences[position] * few
    return graph


def test_a_walk_is_broken_where_too_little_hands_the_scale_on():
    for cells, breaks in ((len(GRID.rays), []), (4, [Break(3, 5)])):
        (watch := Watch(walk_tied_by(cells))).conclude()
        told = {k.frame_index for k in watch.diagnostics if k.scale_deviation is not None}
        assert told == {3, 4, 5} and watch.breaks == breaks


def test_a_scale_that_a_prior_tells_or_that_hardly_any_flow_shows_is_not_asked_for(
    monkeypatch: pytest.MonkeyPatch,
):
    graph = walk_tied_by(4)
    graph.keyframes.prior_disparities[0] = 1.0
    (watch := Watch(graph)).conclude()
    assert watch.breaks == [] and watch.diagnostics[4].scale_deviation is None
    graph.keyframes.prior_disparities[0] = 0.0
    monkeypatch.setattr(diagnostics, "LEAST_BEYOND_TURNS", math.inf)
    (watch := Watch(graph)).conclude()
    assert watch.breaks == [] and watch.diagnostics[4].scale_deviation is None


def test_segments_lie_between_breaks():
    watch = Watch(true_graph([0]))
    watch.diagnostics = keyframes(*[HEALTHY] * 7)
    assert watch.segments == [(0, 60)]
    watch.breaks = [Break(20, 30), Break(60, 60)]
    assert watch.segments == [(0, 10), (40, 50)]
    watch.breaks = [Break(0, 60)]
    assert watch.segments == []


def test_the_longest_piece_is_that_with_most_poses():
    watch, poses = Watch(true_graph([0])), {frame: torch.eye(4) for frame in range(0, 61, 2)}
    watch.diagnostics = keyframes(*[HEALTHY] * 7)
    assert watch.longest_piece(poses) is poses  # without a break, all
    watch.breaks = [Break(30, 30)]
    assert list(watch.longest_piece(poses)) == [*range(0, 21, 2)]
    followed = {frame: poses[frame] for frame in poses if frame > 6}  # the first frames are lost
    assert list(watch.longest_piece(followed)) == [*range(40, 61, 2)]
    watch.breaks = [Break(20, 40)]
    assert list(watch.longest_piece(poses)) == [*range(0, 11, 2)]
    assert watch.longest_piece(few := {frame: poses[frame] for frame in range(0, 9, 2)}) is few
    assert watch.longest_piece({}) == {}  # an interrupted run


def test_what_fits_is_said_in_px_of_a_reference_image_and_no_less_than_of_that():
    residual = diagnostics.EXPLAINED * torch.tensor([[[0.9, 1.1, 1.9, 2.1], [0.0] * 4]])
    for scale, count in ((0.5, 1), (1.0, 1), (2.0, 3)):
        graph = SimpleNamespace(pixel_scale=scale)
        assert int(diagnostics.fitting(graph, residual).sum()) == count
