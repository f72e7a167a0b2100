import math

import pytest
import torch

from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points
from minislam.mapping import InsertionConfig
from minislam.mapping.insertion import (
    draw_pixels,
    gaussians_at_pixels,
    insertable_pixels,
    is_on_dynamic_object,
)
from minislam.splatting import Rendering
from tests.helpers import generator
from tests.mapping.plane_scene import CAMERA, wall_keyframe

CONFIG = InsertionConfig()


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
    gaussians = gaussians_at_pixels(
        pixels, keyframe.image, keyframe.depth, camera, se3_exp(twist), 3, CONFIG
    )
    points = transform_points(se3_exp(twist), gaussians.means.double())
    torch.testing.assert_close(camera.project(points).float(), pixels.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(points[:, 2].float(), torch.full((3,), 2.0))
    size_px = 40.0 * gaussians.scales[0, 0] / 2.0
    assert float(size_px) == pytest.approx(CONFIG.footprint * CONFIG.cell)
    assert torch.equal(gaussians.colors[2], keyframe.image[5, 7])
    assert gaussians.anchor_keyframe.tolist() == [3, 3, 3]
    assert float(gaussians.opacities[0]) == pytest.approx(CONFIG.opacity)


# Identities


@pytest.mark.parametrize(("height", "width", "cell"), [(24, 32, 4), (23, 31, 4), (5, 3, 8)])
def test_each_cell_gives_at_most_one_pixel_inside_the_image(height, width, cell):
    pixels = draw_pixels(torch.ones(height, width, dtype=torch.bool), cell, generator(0))
    cells = (pixels // cell).tolist()
    assert len({tuple(c) for c in cells}) == len(cells)
    assert (pixels >= 0).all() and (pixels < torch.tensor([width, height])).all()
    if height % cell == 0 and width % cell == 0:
        assert len(pixels) == math.prod([height // cell, width // cell])


def test_only_known_pixels_are_drawn_and_the_seed_decides():
    allowed = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    allowed[:, 10:20] = True
    first, second = draw_pixels(allowed, 2, generator(1)), draw_pixels(allowed, 2, generator(1))
    assert torch.equal(first, second)
    assert ((first[:, 0] >= 10) & (first[:, 0] < 20)).all() and len(first) > 40


def test_sparse_depth_is_used_up_to_one_pixel_per_cell():
    known = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    known[1::4, 2::4] = True
    pixels = draw_pixels(known, 4, generator(2))
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
    pixels = draw_pixels(torch.zeros(24, 32, dtype=torch.bool), 4, generator(0))
    gaussians = gaussians_at_pixels(
        pixels, keyframe.image, keyframe.depth, CAMERA, keyframe.T_camera_world, 0, CONFIG
    )
    assert len(gaussians) == 0
