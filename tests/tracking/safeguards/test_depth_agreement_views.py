"""Which disparities several keyframes agree on, on a wall whose depth is known."""

import pytest
import torch

from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards.depth_agreement import agreed_disparities, agreeing_views
from tests.tracking.scene import CAMERA
from tests.tracking.wall import GRID, disparities_at, true_graph

COLUMNS = GRID.shape[1]
MIDDLE = 3 * COLUMNS + 4  # a cell, row 3 and column 4


def spoil(graph: KeyframeGraph, keyframe: int, cell: int, factor: float) -> None:
    graph.keyframes.disparities[keyframe, cell] *= factor


# Known answers


def test_a_cell_is_confirmed_by_all_views_that_see_it():
    graph = true_graph([0, 1, 2, 3])
    poses = graph.keyframes.T_camera_world
    transforms = relative_transforms(poses, [1, 1, 1], [0, 2, 3])
    disparities = disparities_at(poses[1], GRID.rays).expand(3, -1)
    positions, _ = reproject(transforms, disparities, GRID.rays.double(), CAMERA)
    expected = CAMERA.contains(positions.mT).sum(0)
    assert torch.equal(agreeing_views(graph, 1), expected)
    assert 1 < int(expected.max()) <= 3


def test_agreed_disparities_are_those_of_enough_views():
    graph = true_graph([0, 1, 2, 3])
    views, disparities = agreeing_views(graph, 1), graph.keyframes.disparities[1]
    assert torch.equal(agreed_disparities(graph, 1), disparities[views >= 2])
    assert 0 < len(agreed_disparities(graph, 1)) < len(disparities)


def test_a_wrong_disparity_is_confirmed_by_none():
    graph = true_graph([0, 1, 2])
    spoil(graph, 1, MIDDLE, 1.1)
    assert int(agreeing_views(graph, 1)[MIDDLE]) == 0
    assert graph.keyframes.disparities[1, MIDDLE] not in agreed_disparities(graph, 1)


def test_an_error_below_the_tolerance_is_forgiven():
    graph = true_graph([0, 1, 2])
    before = agreeing_views(graph, 1)[MIDDLE]
    spoil(graph, 1, MIDDLE, 1.03)
    assert agreeing_views(graph, 1)[MIDDLE] == before


# Degenerate input


@pytest.mark.parametrize("count", [1, 2])
def test_with_few_keyframes_fewer_must_agree(count: int):
    graph = true_graph(list(range(count)))
    assert MIDDLE < len(agreed_disparities(graph, 0)) <= len(GRID.rays)


def test_if_none_agree_all_are_returned():
    graph = true_graph([0, 1, 2])
    graph.keyframes.disparities[1] *= 2
    assert torch.equal(agreed_disparities(graph, 1), graph.keyframes.disparities[1])
