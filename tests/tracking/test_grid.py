"""The grid of cells: its pixels, its rays, and sampling between cells."""

import math

import pytest
import torch

from minislam.tracking.grid import Grid
from tests.tracking.scene import CAMERA, STRIDE, uniform

GRID = Grid.of(CAMERA, STRIDE)


def test_cells_are_every_eighth_pixel_in_rows():
    assert GRID.shape == (7, 10)
    assert GRID.pixels[:3].tolist() == [[0, 0], [8, 0], [16, 0]]
    assert GRID.pixels[10].tolist() == [0, 8] and GRID.pixels[-1].tolist() == [72, 48]


def test_rays_project_to_the_pixels():
    torch.testing.assert_close(CAMERA.project(3 * GRID.rays), GRID.pixels)


def test_a_refined_focal_length_is_seen_by_all_who_hold_the_grid_and_is_restored():
    grid, other = Grid.of(CAMERA, STRIDE), Grid.of(CAMERA, STRIDE)
    holder = [grid]
    grid.zoom(math.log(1.25))
    assert holder[0].camera.fx == pytest.approx(75)
    torch.testing.assert_close(grid.camera.project(3 * grid.rays), grid.pixels)
    other.restore_state(grid.saved_state(), lambda index: None)
    assert other.camera == grid.camera and torch.equal(other.rays, grid.rays)


def test_a_size_that_is_no_multiple_of_the_stride():
    odd = Grid.of(CAMERA.cropped(0, 0, 75, 41), STRIDE)
    assert odd.shape == (6, 10) and len(odd.rays) == 60


def test_sampling_at_a_cell_returns_its_value():
    values = uniform(0, len(GRID.rays), 3)
    sampled = GRID.sample(values, GRID.pixels.double())
    torch.testing.assert_close(sampled, values, rtol=0, atol=1e-12)


def test_sampling_between_cells_is_linear():
    values = GRID.pixels.double() @ torch.tensor([[1.0, 2.0], [3.0, -1.0]]).double() + 5
    positions = uniform(1, 40, 2) * torch.tensor([72.0, 48.0])
    expected = positions @ torch.tensor([[1.0, 2.0], [3.0, -1.0]]).double() + 5
    # One set of values, as many positions as there are cells or not.
    torch.testing.assert_close(GRID.sample(values, positions), expected, rtol=0, atol=1e-10)


def test_sampling_outside_holds_the_border():
    values = uniform(0, len(GRID.rays), 1)
    outside = torch.tensor([[-30.0, -4.0], [200.0, 48.0]]).double()
    expected = values[[0, -1]]
    torch.testing.assert_close(GRID.sample(values, outside), expected, rtol=0, atol=1e-12)


def test_sampling_many_edges_at_once_is_sampling_each():
    values, positions = uniform(0, 3, len(GRID.rays), 2), 60 * uniform(1, 3, 20, 2)
    together = GRID.sample(values, positions)
    assert together.shape == (3, 20, 2)
    for edge in range(3):
        torch.testing.assert_close(together[edge], GRID.sample(values[edge], positions[edge]))
