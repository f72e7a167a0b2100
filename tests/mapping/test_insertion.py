import math

import pytest
import torch

from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points
from minislam.mapping import InsertionConfig
from minislam.mapping.insertion import (
    SURFACE,
    cell_sides,
    draw_pixels,
    gaussians_at_pixels,
    insertable_pixels,
    is_on_dynamic_object,
)
from minislam.splatting import Rendering
from tests.helpers import generator
from tests.mapping.plane_scene import CAMERA, wall_keyframe

CONFIG = InsertionConfig()


def cells_of(side: int, height: int = CAMERA.height, width: int = CAMERA.width) -> torch.Tensor:
    return torch.full((height, width), side)


def rendering_with(depth: torch.Tensor, opacity: torch.Tensor) -> Rendering:
    return Rendering(torch.zeros(*depth.shape, 3), depth, opacity, torch.ones(1))


# Known answers


def test_a_pixel_is_inserted_only_if_known_near_static_and_unexplained():
    #                     plain far   unknown mover covered thin
    depth = torch.tensor([[2.0, 50.0, 0.0, 2.0, 2.0, 2.0]])
    weight = torch.tensor([[1.0, 1.0, 1.0, 0.0, 1.0, 1.0]])
    opacity = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.95, 0.5]])
    allowed = insertable_pixels(depth, 20.0, weight, rendering_with(depth, opacity))
    assert allowed.tolist() == [[True, False, False, False, False, True]]
    assert insertable_pixels(depth, 20.0, weight, None).sum() == 3


def test_new_gaussians_project_to_their_pixels_with_the_size_of_a_cell():
    camera = Camera(40.0, 40.0, 14.0, 11.0, 32, 24)
    keyframe = wall_keyframe(3)
    twist = torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64)
    pixels = torch.tensor([[0, 0], [31, 23], [7, 5]])
    sides = cells_of(2)
    sides[5, 7] = 8
    gaussians = gaussians_at_pixels(
        pixels, sides, keyframe.image, keyframe.depth, camera, se3_exp(twist), 3, CONFIG
    )
    points = transform_points(se3_exp(twist), gaussians.means.double())
    torch.testing.assert_close(camera.project(points).float(), pixels.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(points[:, 2].float(), torch.full((3,), 2.0))
    sizes_px = 40.0 * gaussians.scales[:, 0] / 2.0
    torch.testing.assert_close(sizes_px, CONFIG.footprint * torch.tensor([2.0, 2.0, 8.0]))
    assert torch.equal(gaussians.colors[2], keyframe.image[5, 7])
    assert gaussians.anchor_keyframe.tolist() == [3, 3, 3]
    assert float(gaussians.opacities[0]) == pytest.approx(CONFIG.opacity)


def test_a_cell_is_wide_where_one_colour_and_one_surface_fill_it():
    image, depth = torch.full((32, 48, 3), 0.5), torch.full((32, 48), 2.0)
    image[3, 35] = 1.0  # a fleck in a plain wall, .06 too bright once it is smooth
    image[20:, 40:, 2] = 0.0  # an edge of one colour
    depth[18:, 3:5] = 1.01 * SURFACE * 2.0  # another surface of the same colour
    depth[0, 16] = 0.0  # unknown
    eight, four, two = 8, 4, 2
    sides = cell_sides(image, depth, 2, plain=0.12)
    assert sides[16, 24] == eight and sides[3, 35] == eight
    assert sides[20, 40] == two and sides[20, 42] == two and sides[24, 44] == four
    assert sides[12, 1] == eight and sides[17, 1] == two and sides[24, 6] == two
    assert (cell_sides(image, depth, 2, plain=0.05)[0:4, 32:36] == two).all()  # the fleck
    assert (cell_sides(image, depth, 2, plain=0.0) == two).all()
    assert sides[0, 16] == two and sides[0, 20] == four and sides[5, 17] == four


def test_each_cell_of_several_sides_gives_one_pixel():
    sides = cells_of(2, 24, 32)
    sides[:8, 8:16], sides[16:20, 4:8] = 8, 4
    pixels = draw_pixels(torch.ones(24, 32, dtype=torch.bool), sides, generator(3))
    side = sides[pixels[:, 1], pixels[:, 0]]
    assert [int((side == s).sum()) for s in (2, 4, 8)] == [24 * 32 // 4 - 16 - 4, 1, 1]
    cells = torch.cat([pixels // side[:, None], side[:, None]], -1)
    assert len(cells.unique(dim=0)) == len(cells)


# Identities


@pytest.mark.parametrize(("height", "width", "cell"), [(24, 32, 4), (23, 31, 4), (5, 3, 8)])
def test_each_cell_gives_at_most_one_pixel_inside_the_image(height, width, cell):
    known = torch.ones(height, width, dtype=torch.bool)
    pixels = draw_pixels(known, cells_of(cell, height, width), generator(0))
    cells = (pixels // cell).tolist()
    assert len({tuple(c) for c in cells}) == len(cells)
    assert (pixels >= 0).all() and (pixels < torch.tensor([width, height])).all()
    if height % cell == 0 and width % cell == 0:
        assert len(pixels) == math.prod([height // cell, width // cell])


def test_only_known_pixels_are_drawn_and_the_seed_decides():
    allowed = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    allowed[:, 10:20] = True
    first, second = (draw_pixels(allowed, cells_of(2), generator(1)) for _ in range(2))
    assert torch.equal(first, second)
    assert ((first[:, 0] >= 10) & (first[:, 0] < 20)).all() and len(first) > 40


def test_sparse_depth_is_used_up_to_one_pixel_per_cell():
    known = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    known[1::4, 2::4] = True
    pixels = draw_pixels(known, cells_of(4), generator(2))
    assert len(pixels) == 6 * 8 and (pixels % 4 == torch.tensor([2, 1])).all()


def test_a_gaussian_on_a_mover_of_its_own_keyframe_is_found():
    weight = torch.ones(CAMERA.height, CAMERA.width)
    weight[4:8, 10:20] = 0
    pixels = torch.tensor([[12.0, 5.0], [12.0, 9.0], [12.0, 5.0], [12.0, 5.0]])
    depth = torch.tensor([2.0, 2.0, 3.0, -2.0])
    pose = se3_exp(torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64))
    points = CAMERA.backproject(pixels, depth).double()
    means = transform_points(se3_inverse(pose), points).float()
    found = is_on_dynamic_object(means, CAMERA, pose, weight)
    assert found.tolist() == [True, False, True, False]
    found = is_on_dynamic_object(means, CAMERA, pose, torch.zeros_like(weight))
    assert found.tolist() == [True, True, True, False]  # behind the camera nothing is seen


# Degenerate input


def test_nothing_allowed_gives_an_empty_map():
    keyframe = wall_keyframe(0)
    pixels = draw_pixels(torch.zeros(24, 32, dtype=torch.bool), cells_of(4), generator(0))
    view = cells_of(4), keyframe.image, keyframe.depth, CAMERA, keyframe.T_camera_world
    gaussians = gaussians_at_pixels(pixels, *view, 0, CONFIG)
    assert len(gaussians) == 0
