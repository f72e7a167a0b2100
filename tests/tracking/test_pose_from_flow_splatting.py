"""Disparities warped from one view to another."""

from dataclasses import replace

import pytest
import torch

from minislam.tracking.grid import Grid
from minislam.tracking.pose_from_flow import splat_disparities
from tests.tracking.scene import CAMERA, RAYS, STRIDE, uniform

GRID = replace(Grid.of(CAMERA, STRIDE), rays=RAYS)  # in float64


def test_splatting_into_the_same_view_changes_nothing():
    disparities = 0.2 + 0.3 * uniform(0, len(RAYS))
    identity = torch.eye(4, dtype=torch.float64)
    warped = splat_disparities(GRID, identity, disparities)
    torch.testing.assert_close(warped, disparities)


def test_splatting_moves_by_whole_cells_and_leaves_holes():
    # 60 px * t * d = 8 px: one cell to the left.
    disparities = torch.full((len(RAYS),), 0.4, dtype=torch.float64)
    disparities[:10] = torch.linspace(0.39, 0.41, 10, dtype=torch.float64)
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -8 / (60 * 0.4)
    warped = splat_disparities(GRID, transform, disparities)
    before, after = disparities.reshape(GRID.shape), warped.reshape(GRID.shape)
    torch.testing.assert_close(after[:, :-1], before[:, 1:])
    assert (after[:, -1] == 0).all()


def test_disparities_change_with_the_depth():
    transform = torch.eye(4, dtype=torch.float64)
    transform[2, 3] = 1.0  # the camera goes back by 1: depth 2 becomes 3
    disparities = torch.full((len(RAYS),), 0.5, dtype=torch.float64)
    warped = splat_disparities(GRID, transform, disparities)
    filled = warped[warped > 0]
    torch.testing.assert_close(filled, torch.full_like(filled, 1 / 3))


@pytest.mark.parametrize("near_first", [True, False])
def test_the_nearest_point_wins(near_first: bool):
    # In one row, cells at 16 px and 48 px meet at 0 px: 60 t 0.4 = 16, 60 t 1.2 = 48.
    disparities = torch.full((len(RAYS),), 1e-3, dtype=torch.float64)
    far, near = disparities.reshape(GRID.shape)[3, 2:7:4], 1.2
    far.copy_(torch.tensor([0.4, near]))
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -16 / (60 * 0.4)
    order = torch.arange(len(RAYS)) if near_first else torch.arange(len(RAYS)).flip(0)
    grid = replace(GRID, rays=RAYS[order])
    warped = splat_disparities(grid, transform, disparities[order]).reshape(GRID.shape)
    assert float(warped[3, 0]) == pytest.approx(near)


def test_points_that_leave_the_image_or_pass_the_camera_are_dropped():
    transform = torch.eye(4, dtype=torch.float64)
    transform[2, 3] = -3.0  # beyond everything that is nearer than 3
    disparities = torch.full((len(RAYS),), 0.5, dtype=torch.float64)
    warped = splat_disparities(GRID, transform, disparities)
    assert (warped == 0).all()
