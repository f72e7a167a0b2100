"""Exposure: told by matches of what stands still, taken out of images, put back into pictures."""

from dataclasses import replace

import pytest
import torch

from minislam.geometry import Camera
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards import exposure
from minislam.tracking.safeguards.exposure import with_exposure
from tests.tracking.wall import TrueFlow, true_graph

FRAMES = [0, 3, 6, 9]
FACTORS = torch.tensor([[1.0, 1.0, 1.0], [0.7, 0.8, 0.9], [1.3, 1.2, 1.0], [1.0, 1.0, 1.0]])


def exposed_graph(factors: torch.Tensor, linked: int = len(FRAMES)) -> KeyframeGraph:
    """Return a graph with the true flow of a grey wall, exposed by these factors."""
    graph = true_graph(FRAMES)
    graph.match(neighbourhood_edges(0, linked, 5))
    frames = graph.keyframes.frames
    for index, (frame, factor) in enumerate(zip(frames, factors, strict=True)):
        frames[index] = replace(frame, pixels=torch.ones_like(frame.image) * 0.5 * factor)
    return graph


def keyframe_exposures(
    graph: KeyframeGraph, static_weights: torch.Tensor | None = None
) -> dict[int, torch.Tensor]:
    every = torch.ones_like(graph.keyframes.disparities)
    return exposure.keyframe_exposures(graph, every if static_weights is None else static_weights)


def factors(exposures: dict[int, torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(exposures.values()))


# Known answers


def test_the_exposures_are_found_with_their_median_at_one():
    found = keyframe_exposures(exposed_graph(FACTORS))
    assert list(found) == FRAMES
    torch.testing.assert_close(factors(found), FACTORS, rtol=0.01, atol=0)


def test_one_exposure_is_left_alone():
    steady = 1 + 0.02 * torch.tensor([[0.0], [1.0], [-1.0], [0.5]]).expand(4, 3)
    assert keyframe_exposures(exposed_graph(steady)) == {}


@pytest.mark.parametrize("told_by", ["memory", "beta"])
def test_what_moves_has_no_say(told_by: str):
    graph, by_beta = exposed_graph(FACTORS), []
    for index, frame in enumerate(graph.keyframes.frames):
        dark = frame.image.clone()
        dark[:, : dark.shape[1] // 2] *= 0.5 if index == 1 else 1
        graph.keyframes.frames[index] = replace(frame, pixels=dark)
        stands = torch.ones(graph.grid.shape)
        stands[:, : graph.grid.shape[1] // 2 + 2] = 0
        by_beta.append(stands.reshape(-1))
        if told_by == "memory":
            graph.keyframes.motion_weights[index] = by_beta.pop()
    found = keyframe_exposures(graph, torch.stack(by_beta) if by_beta else None)
    torch.testing.assert_close(factors(found), FACTORS, rtol=0.02, atol=0)


def test_a_shiny_thing_has_no_more_say_for_its_texture():
    graph = exposed_graph(torch.ones(4, 3))
    quarter = graph.grid.shape[1] // 4
    for index, frame in enumerate(graph.keyframes.frames):
        shiny = frame.image.clone()
        shiny[:, : shiny.shape[1] // 4] *= 0.8**index
        graph.keyframes.frames[index] = replace(frame, pixels=shiny)
    textured = torch.full(graph.grid.shape, 0.05)
    textured[:, : quarter + 1] = 1
    edges = graph.edges
    edges.confidences = [seen * textured.reshape(-1) for seen in edges.confidences]
    assert keyframe_exposures(graph) == {}


def test_a_frame_between_keyframes_is_exposed_as_between_them():
    exposures = {0: torch.ones(3), 4: torch.tensor([4.0, 1.0, 1.0])}
    frame = Frame(2, 0.1, torch.full((2, 2, 3), 0.5))
    between = with_exposure(frame, exposures)
    torch.testing.assert_close(between.exposure, torch.tensor([2.0, 1.0, 1.0]))
    torch.testing.assert_close(between.levelled[0, 0], torch.tensor([0.25, 0.5, 0.5]))
    torch.testing.assert_close(between.exposed(between.levelled), frame.image)
    last = with_exposure(replace(frame, frame_index=9), exposures)
    assert last.exposure[0] == pytest.approx(4)


def test_links_of_little_weight_tell_as_much():
    graph = exposed_graph(FACTORS)
    for index in range(len(FRAMES)):
        graph.keyframes.static_weights[index] = torch.full_like(graph.grid.rays[:, 0], 0.02)
    torch.testing.assert_close(factors(keyframe_exposures(graph)), FACTORS, rtol=0.01, atol=0)


def test_chance_matches_tell_nothing():
    graph = exposed_graph(torch.tensor([1.0, 1.0, 1.0, 0.7])[:, None].expand(4, 3))
    graph.keyframes.static_weights[3] = torch.full_like(graph.grid.rays[:, 0], 0.001)
    assert keyframe_exposures(graph) == {}


def test_a_keyframe_without_links_is_exposed_like_its_neighbour():
    graph = exposed_graph(torch.tensor([0.7, 0.7, 1.3, 1.3])[:, None].expand(4, 3), linked=3)
    found = keyframe_exposures(graph)
    torch.testing.assert_close(found[FRAMES[3]], found[FRAMES[2]], rtol=1e-3, atol=0)
    torch.testing.assert_close(
        found[FRAMES[2]] / found[0], torch.full((3,), 1.3 / 0.7), rtol=0.02, atol=0
    )


def test_the_grid_may_have_more_cells_than_opencv_has_rows():
    flow = TrueFlow()
    flow.stride = 1
    graph = KeyframeGraph(Camera(200, 200, 128, 64, 256, 128), TrackingConfig(), flow)
    ones, pose = torch.ones(128 * 256), torch.eye(4)
    for index, light in enumerate([0.4, 0.6]):
        frame = Frame(index, 0.1 * index, torch.full((128, 256, 3), light))
        graph.keyframes.append(frame, torch.zeros(1, 1, 1), None, pose, ones, ones)
    still = graph.grid.pixels.T[None]
    graph.edges.record([(0, 1)], FlowMatches(still, torch.ones_like(still), torch.ones(1)))
    found = factors(keyframe_exposures(graph))
    torch.testing.assert_close(found[1] / found[0], torch.full((3,), 1.5))


# Degenerate input


def test_nothing_matched_or_all_black_tells_nothing():
    graph = true_graph(FRAMES)
    assert keyframe_exposures(graph) == {}
    black = exposed_graph(torch.full((4, 3), 0.05))
    assert keyframe_exposures(black) == {}
    frame = Frame(2, 0.1, torch.zeros(2, 2, 3))
    assert with_exposure(frame, {}).exposure is None
    assert frame.levelled is frame.pixels
