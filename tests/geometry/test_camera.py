"""The pinhole camera: pixels and points, their Jacobians, resizing and cropping."""

import cv2
import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera, se3_exp, transform_points
from minislam.geometry.camera import pixel_scale
from minislam.geometry.se3 import hat
from tests.helpers import assert_gradients_close, generator, numerical_jacobian

# fx != fy and a principal point off the centre: symmetric cameras hide mistakes.
CAMERA = Camera(fx=70.0, fy=90.0, cx=41.3, cy=22.8, width=101, height=53)


def points_in_front(count: int = 20, seed: int = 0) -> torch.Tensor:
    """Return points (count, 3) between 1 and 5 units in front of the camera."""
    points = torch.randn(count, 3, generator=generator(seed), dtype=torch.float64)
    points[:, 2] = 1 + 4 * torch.rand(count, generator=generator(seed + 1), dtype=torch.float64)
    return points


# Known answers


def test_a_point_projects_by_hand():
    # u = 70 * 0.5 / 2 + 41.3 = 58.8, v = 90 * (-0.4) / 2 + 22.8 = 4.8
    uv = CAMERA.project(torch.tensor([0.5, -0.4, 2.0], dtype=torch.float64))
    torch.testing.assert_close(uv, torch.tensor([58.8, 4.8], dtype=torch.float64))


def test_points_on_the_axis_hit_the_principal_point_at_any_depth():
    points = torch.tensor([[0, 0, 0.1], [0, 0, 1], [0, 0, 50.0]], dtype=torch.float64)
    expected = torch.tensor([41.3, 22.8], dtype=torch.float64).expand(3, 2)
    torch.testing.assert_close(CAMERA.project(points), expected)


def test_the_grid_starts_at_zero_and_ends_at_the_last_pixel():
    grid = CAMERA.pixel_grid()
    assert grid.shape == (53, 101, 2)
    assert grid[0, 0].tolist() == [0, 0]
    assert grid[-1, -1].tolist() == [100, 52]
    assert grid[2, 7].tolist() == [7, 2]  # (row, column) in, (u, v) out


def test_a_strided_grid_has_a_cell_for_every_started_stride():
    grid = CAMERA.pixel_grid(stride=8, dtype=torch.float64)
    assert grid.shape == (7, 13, 2)  # ceil(53 / 8), ceil(101 / 8)
    assert grid[1, 2].tolist() == [16, 8]
    assert grid.dtype == torch.float64


def test_pixel_scale_is_one_at_320x240_and_follows_the_diagonal():
    assert pixel_scale(Camera(200, 200, 160, 120, 320, 240)) == 1
    assert pixel_scale(Camera(400, 400, 320, 240, 640, 480)) == 2
    assert pixel_scale(CAMERA.resized(300, 400)) == 500 / 400


# Identities


@pytest.mark.parametrize("depth", [1e-3, 1.0, 7.0, 1e4])
def test_project_undoes_backproject_for_every_pixel(depth: float):
    grid = CAMERA.pixel_grid(dtype=torch.float64)
    depths = torch.full(grid.shape[:2], depth, dtype=torch.float64)
    points = CAMERA.backproject(grid, depths)
    assert (points[..., 2] == depths).all()
    assert (CAMERA.project(points) - grid).abs().max() < 1e-12


def test_resizing_there_and_back_gives_the_same_camera():
    back = CAMERA.resized(37, 29).resized(CAMERA.width, CAMERA.height)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert abs(getattr(back, name) - getattr(CAMERA, name)) < 1e-12


def test_resizing_moves_every_pixel_by_the_half_pixel_rule():
    resized = CAMERA.resized(202, 26)
    points = points_in_front()
    scale = torch.tensor([202 / 101, 26 / 53], dtype=torch.float64)
    expected = (CAMERA.project(points) + 0.5) * scale - 0.5
    assert (resized.project(points) - expected).abs().max() < 1e-12


def test_resizing_a_camera_does_what_opencv_does_to_the_image():
    # The image holds its own u coordinate; after resizing, a pixel must hold what the rule says.
    image = np.broadcast_to(np.arange(96, dtype=np.float32), (48, 96)).copy()
    small = cv2.resize(image, (24, 12), interpolation=cv2.INTER_AREA)
    big = cv2.resize(image, (192, 96), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(small[0], (np.arange(24) + 0.5) * 4 - 0.5, rtol=1e-6)
    np.testing.assert_allclose(big[0, 2:-2], ((np.arange(192) + 0.5) / 2 - 0.5)[2:-2], rtol=1e-6)


def test_the_image_centre_and_its_outer_corners_stay_there_under_resizing():
    centred = Camera(50, 50, (64 - 1) / 2, (48 - 1) / 2, 64, 48)
    resized = centred.resized(20, 15)
    assert (resized.cx, resized.cy) == ((20 - 1) / 2, (15 - 1) / 2)
    # The outer corner (-0.5, -0.5) sees the same ray before and after.
    corner = torch.tensor([-0.5, -0.5], dtype=torch.float64)
    torch.testing.assert_close(resized.rays(corner), centred.rays(corner))


def test_a_principal_point_on_the_border_stays_there_under_resizing():
    for before in range(1, 60):
        for after in range(1, 60):
            camera = Camera(50, 50, before - 0.5, before - 0.5, before, before)
            resized = camera.resized(after, after)
            assert resized.cx == resized.cy == pytest.approx(after - 0.5)


def test_cropping_shifts_pixels_by_the_corner_of_the_window():
    cropped = CAMERA.cropped(left=10, top=5, width=60, height=40)
    points = points_in_front()
    shift = torch.tensor([10.0, 5.0], dtype=torch.float64)
    assert (cropped.project(points) - (CAMERA.project(points) - shift)).abs().max() < 1e-12


def test_contains_is_about_pixel_centres():
    pixels = torch.tensor([[0.0, 0], [100, 52], [-0.1, 0], [100.1, 0], [5, 52.1], [3, 3]])
    assert CAMERA.contains(pixels).tolist() == [True, True, False, False, False, True]


# Gradients


def test_project_jacobian_agrees_with_differences_and_autograd():
    points = points_in_front()
    jacobian = CAMERA.project_jacobian(points)
    for k, point in enumerate(points):
        numeric = numerical_jacobian(CAMERA.project, point)
        exact = torch.autograd.functional.jacobian(CAMERA.project, point)
        assert_gradients_close(jacobian[k], numeric)
        assert_gradients_close(jacobian[k], exact, relative=1e-12)


def twist_jacobian(points: torch.Tensor) -> torch.Tensor:  # (N, 3) -> (N, 2, 6)
    x, y, z = points.unbind(-1)
    return CAMERA.twist_jacobian(x / z, y / z, 1 / z).permute(2, 1, 0)


def test_twist_jacobian_agrees_with_differences_and_autograd():
    points = points_in_front()
    jacobian = twist_jacobian(points)
    still = torch.zeros(6, dtype=torch.float64)
    for k, point in enumerate(points):

        def moved(xi: torch.Tensor, point: torch.Tensor = point) -> torch.Tensor:
            return CAMERA.project(transform_points(se3_exp(xi), point[None])[0])

        assert_gradients_close(jacobian[k], numerical_jacobian(moved, still))
        exact = torch.autograd.functional.jacobian(moved, still)
        assert_gradients_close(jacobian[k], exact, relative=1e-12)


def test_twist_jacobian_is_that_of_the_projection_times_the_motion_of_the_point():
    # d(rho + phi x p)/d(rho, phi) = [I | -hat(p)]
    points = points_in_front()
    identity = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    motion = torch.cat([identity, -hat(points)], -1)
    expected = CAMERA.project_jacobian(points) @ motion
    torch.testing.assert_close(twist_jacobian(points), expected)


def test_twist_jacobian_keeps_leading_dimensions():
    x, y, e = (torch.rand(4, 5, 7, generator=generator(k)) for k in range(3))
    batched = CAMERA.twist_jacobian(x, y, e)
    assert batched.shape == (4, 5, 6, 2, 7)
    assert torch.equal(batched[2, 3], CAMERA.twist_jacobian(x[2, 3], y[2, 3], e[2, 3]))


def test_a_point_at_infinity_is_moved_by_rotation_alone():
    x, y = torch.tensor([0.3]), torch.tensor([-0.2])
    jacobian = CAMERA.twist_jacobian(x, y, torch.zeros(1))
    assert (jacobian[:3] == 0).all() and (jacobian[3:] != 0).all()


# Degenerate input


def test_a_camera_of_one_pixel_works():
    camera = Camera(1.0, 1.0, 0.0, 0.0, 1, 1)
    assert camera.pixel_grid().tolist() == [[[0.0, 0.0]]]
    assert camera.resized(2, 2).cx == 0.5


def test_no_points_give_no_pixels():
    assert CAMERA.project(torch.zeros(0, 3)).shape == (0, 2)
    assert CAMERA.project_jacobian(torch.zeros(0, 3)).shape == (0, 2, 3)


# Errors


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ((0.0, 50, 31, 23, 64, 48), "found fx=0.0"),
        ((50, -1.0, 31, 23, 64, 48), "fy=-1.0"),
        ((float("nan"), 50, 31, 23, 64, 48), "fx=nan"),
        ((50, 50, 64.0, 23, 64, 48), "found cx=64.0"),
        ((50, 50, 31, 48.0, 64, 48), "cy=48.0"),
        ((50, float("nan"), 31, 23, 64, 48), "fy=nan"),
        ((50, 50, 31, 23, 0, 48), "at least 1x1 pixels, found 0x48"),
        ((50, 50, 64, 23, 64, 48), "inside the 64x48 image, found cx=64"),
        ((50, 50, 31, -0.6, 64, 48), "cy=-0.6"),
        ((50, 50, float("nan"), 23, 64, 48), "cx=nan"),
    ],
)
def test_impossible_cameras_are_refused_in_one_sentence(values: tuple, sentence: str):
    with pytest.raises(InputError, match=sentence):
        Camera(*values)
