"""Depth images from the tracker's own disparities, on a wall whose depth is known."""

import pytest
import torch
from torch import Tensor

from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards.structure import (
    EDGE_RATIO,
    agreeing_views,
    depth_from_disparities,
)
from tests.tracking.scene import CAMERA, STRIDE
from tests.tracking.wall import GRID, disparities_at, true_graph, true_poses

COLUMNS = GRID.shape[1]
MIDDLE = 3 * COLUMNS + 4  # a cell, row 3 and column 4


def spoil(graph: KeyframeGraph, keyframe: int, cell: int, factor: float) -> None:
    graph.keyframes.disparities[keyframe, cell] *= factor


def square(row: int, column: int) -> tuple[slice, slice]:
    """Return the pixels between a cell and its right and lower neighbours."""
    first_row, first_column = row * STRIDE, column * STRIDE
    return slice(first_row, first_row + STRIDE), slice(first_column, first_column + STRIDE)


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


def test_the_depth_of_the_wall_is_found_in_every_pixel_between_cells():
    graph = true_graph([0, 1, 2])
    depth = depth_from_disparities(graph, 1)
    assert depth.shape == (CAMERA.height, CAMERA.width) and depth.dtype == torch.float32
    inside = depth[: 6 * STRIDE + 1, : 9 * STRIDE + 1]
    rays = CAMERA.rays(CAMERA.pixel_grid(1, torch.float64))[: len(inside), : inside.shape[1]]
    truth = 1 / disparities_at(true_poses()[1], rays)
    known = inside > 0
    assert known.double().mean() > 0.5
    torch.testing.assert_close(inside[known].double(), truth[known], rtol=2e-3, atol=0)


def test_a_wrong_disparity_is_confirmed_by_none_and_its_squares_are_unknown():
    graph = true_graph([0, 1, 2])
    assert depth_from_disparities(graph, 1)[square(3, 4)].min() > 0
    spoil(graph, 1, MIDDLE, 1.1)
    assert int(agreeing_views(graph, 1)[MIDDLE]) == 0
    depth = depth_from_disparities(graph, 1)
    for row, column in [(3, 4), (2, 4), (3, 3), (2, 3)]:
        assert depth[square(row, column)].max() == 0
    assert depth[square(4, 5)].min() > 0


def test_an_error_below_the_tolerance_is_forgiven():
    graph = true_graph([0, 1, 2])
    before = agreeing_views(graph, 1)[MIDDLE]
    spoil(graph, 1, MIDDLE, 1.03)
    assert agreeing_views(graph, 1)[MIDDLE] == before


def test_cells_without_trust_are_unknown():
    graph = true_graph([0, 1, 2])
    graph.keyframes.static_weights[1, MIDDLE] = 0
    assert depth_from_disparities(graph, 1)[square(3, 4)].max() == 0


def test_nothing_is_interpolated_across_an_edge():
    graph = true_graph([0, 1, 2])
    step = torch.ones(GRID.shape)
    step[:, 5:] = EDGE_RATIO * 1.1
    depth = depth_with_all_confirmed(graph, step.reshape(-1))
    assert depth[:, 4 * STRIDE : 5 * STRIDE].max() == 0
    assert depth[:, 3 * STRIDE : 4 * STRIDE].min() > 0
    assert depth[:, 5 * STRIDE : 6 * STRIDE].min() > 0


def depth_with_all_confirmed(graph: KeyframeGraph, factors: Tensor) -> Tensor:
    """Return keyframe 1's depth if both its neighbours stand in the same place and agree."""
    for keyframe in range(3):
        graph.keyframes.T_camera_world[keyframe] = torch.eye(4, dtype=torch.float64)
        graph.keyframes.disparities[keyframe] = 0.25 * factors
    return depth_from_disparities(graph, 1)


# Degenerate input


@pytest.mark.parametrize("count", [1, 2])
def test_with_few_keyframes_fewer_must_agree(count: int):
    depth = depth_from_disparities(true_graph(list(range(count))), 0)
    assert depth[square(3, 4)].min() > 0
    assert depth.isfinite().all() and depth.min() >= 0
