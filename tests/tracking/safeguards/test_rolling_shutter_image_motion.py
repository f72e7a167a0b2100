"""How fast the image moves, measured, and how far a rolling shutter displaces it."""

from dataclasses import replace

import pytest
import torch

from minislam.tracking.safeguards.rolling_shutter import ImageMotion
from tests.tracking.safeguards.moving_cloth import GRID, RATE, WIDE, picture


def test_the_velocity_is_that_of_the_image_before_and_after():
    motion = ImageMotion(GRID)
    for index, columns in enumerate((0, 3, 8)):
        motion.see(picture(index, columns))
    inside = (GRID.pixels > 24).all(1) & (GRID.pixels < torch.tensor([136, 96])).all(1)
    for frame, wanted in ((0, 3), (1, 4), (2, 5)):
        u = motion.velocity(frame)[:, inside] / RATE
        torch.testing.assert_close(u[0], torch.full_like(u[0], wanted), rtol=0, atol=0.3)
        assert u[1].abs().max() < 0.3
    assert motion.shortest_step == pytest.approx(1 / RATE)
    motion.see(replace(picture(3, 12), step=0.25 / RATE))  # every fourth image of the source
    assert motion.shortest_step == 0.25 / RATE


def test_a_frame_without_a_neighbour_does_not_move():
    motion = ImageMotion(GRID)
    assert not motion.velocity(0).any()
    motion.see(picture(0, 0))
    assert not motion.velocity(0).any()


def test_the_motion_of_a_frame_does_not_depend_on_how_many_came_before_the_start():
    found = []
    for first in (0, 7):
        motion = ImageMotion(GRID)
        for index in range(3):
            motion.see(picture(first + index, 3 * index))
        found.append([motion.velocity(first + index) for index in range(3)])
    assert all(torch.allclose(*pair, atol=1e-3) for pair in zip(*found, strict=True))
    assert found[0][1].abs().max() > 30


def test_a_row_read_late_is_displaced_by_what_the_image_moved_meanwhile():
    motion = ImageMotion(GRID)
    motion.velocities = [torch.tensor([[50.0], [-20.0]]).expand(2, len(GRID.pixels))] * 2
    moved = motion.displacement(0, (0.0, 0.04))
    assert moved is not None and moved.shape == (WIDE.height, WIDE.width, 2)
    for row, late in ((0, -0.5), (60, 0.0), (112, 112 / 120 - 0.5)):
        assert moved[row, 80] == pytest.approx((50 * 0.04 * late, -20 * 0.04 * late), abs=1e-4)
    assert motion.displacement(0, (0.0, 0.0)) is None
    assert motion.displacement(0, (0.0, 0.001)) is None  # less than a tenth of a pixel
