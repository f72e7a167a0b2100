"""The conventions of `minislam.geometry`, one test per sentence of its docstring."""

import math

import cv2
import numpy as np
import pytest
import torch

import minislam.geometry
from minislam.errors import InputError
from minislam.geometry import Camera, se3_adjoint, se3_exp, se3_inverse, transform_points
from minislam.geometry.se3 import make_transform, rotation_from_quaternion
from tests.helpers import random_transforms

CAMERA = Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
IDENTITY = torch.eye(3, dtype=torch.float64)


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


# Frames


def test_p_world_is_T_world_camera_times_p_camera():
    # A camera at (1, 2, 3), not turned: a point 5 in front of it is at (1, 2, 8) in the world.
    T_world_camera = make_transform(IDENTITY, vector(1, 2, 3))
    p_world = transform_points(T_world_camera, vector(0, 0, 5)[None])[0]
    assert p_world.tolist() == [1, 2, 8]


def test_camera_centre_is_translation_of_T_world_camera():
    T_camera_world = random_transforms(1, "normal", 0)[0]
    centre = se3_inverse(T_camera_world)[:3, 3]
    torch.testing.assert_close(transform_points(T_camera_world, centre[None])[0], vector(0, 0, 0))


def test_inner_names_cancel():
    T_a_b, T_b_c = random_transforms(2, "normal", 1)
    p_c = vector(0.3, -0.2, 1.5)[None]
    through_b = transform_points(T_a_b, transform_points(T_b_c, p_c))
    torch.testing.assert_close(transform_points(T_a_b @ T_b_c, p_c), through_b)


# Camera


def test_x_is_right_y_is_down_z_is_forward():
    centre = CAMERA.project(vector(0, 0, 1))
    assert CAMERA.project(vector(0.1, 0, 1))[0] > centre[0]  # right: larger column
    assert CAMERA.project(vector(0, 0.1, 1))[1] > centre[1]  # down: larger row
    right_handed = torch.linalg.cross(vector(1, 0, 0), vector(0, 1, 0))
    assert right_handed.tolist() == [0, 0, 1]


def test_depth_is_z_and_not_the_length_of_the_ray():
    point = CAMERA.backproject(vector(0, 0), torch.tensor(2.0, dtype=torch.float64))
    assert point[2] == 2 and point.norm() > 2.1


# Pixels


def test_pixel_is_column_then_row_and_the_first_centre_is_zero():
    grid = CAMERA.pixel_grid()
    assert grid[0, 0].tolist() == [0, 0]
    assert grid[5, 9].tolist() == [9, 5]


def test_an_image_covers_half_a_pixel_around_its_outer_centres():
    outermost = Camera(10, 10, -0.5, 47.5, 64, 48)
    assert (outermost.resized(32, 24).cx, outermost.resized(32, 24).cy) == (-0.5, 23.5)
    with pytest.raises(InputError):
        Camera(10, 10, -0.51, 47.5, 64, 48)


def test_resizing_maps_c_to_c_plus_half_times_s_minus_half():
    # A bright square of 8x8 pixels keeps its centre of mass under the rule, at every scale.
    image = np.zeros((48, 64), np.float32)
    image[16:24, 32:40] = 1  # centre (35.5, 19.5)
    for width, height in ((32, 24), (16, 12), (8, 6)):
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        scale = width / 64
        u = (small.sum(0) * np.arange(width)).sum() / small.sum()
        v = (small.sum(1) * np.arange(height)).sum() / small.sum()
        assert abs(u - ((35.5 + 0.5) * scale - 0.5)) < 1e-5
        assert abs(v - ((19.5 + 0.5) * scale - 0.5)) < 1e-5
        resized = CAMERA.resized(width, height)
        assert abs(resized.cx - ((31.5 + 0.5) * scale - 0.5)) < 1e-12


# Tangent vectors


def test_translation_comes_first_in_a_tangent_vector():
    assert se3_exp(vector(1, 2, 3, 0, 0, 0))[:3, 3].tolist() == [1, 2, 3]
    turned = se3_exp(vector(0, 0, 0, 0, 0, math.pi / 2))
    assert turned[:3, 3].abs().max() == 0
    torch.testing.assert_close(turned[:3, 0], vector(0, 1, 0))


def test_an_update_from_the_left_moves_the_world_in_the_camera_frame():
    T_camera_world = random_transforms(1, "normal", 2)[0]
    p_camera = vector(0.2, 0.1, 2.0)
    p_world = transform_points(se3_inverse(T_camera_world), p_camera[None])
    xi = vector(0.01, -0.02, 0.03, 0, 0, 0)
    moved = transform_points(se3_exp(xi) @ T_camera_world, p_world)[0]
    torch.testing.assert_close(moved, p_camera + xi[:3])


def test_left_and_right_updates_differ_by_the_adjoint():
    T_camera_world = random_transforms(1, "normal", 3)[0]
    xi = vector(0.1, 0.2, -0.1, 0.3, 0.1, -0.2)
    right = T_camera_world @ se3_exp(xi)
    left = se3_exp(se3_adjoint(T_camera_world) @ xi) @ T_camera_world
    torch.testing.assert_close(left, right)


# Quaternions


def test_quaternions_are_wxyz():
    half = math.sqrt(0.5)
    rotation = rotation_from_quaternion(vector(half, 0, 0, half))  # a quarter turn about z
    torch.testing.assert_close(rotation @ vector(1, 0, 0), vector(0, 1, 0))
    torch.testing.assert_close(rotation_from_quaternion(vector(1, 0, 0, 0)), IDENTITY)


# Units


def test_angles_are_radians():
    torch.testing.assert_close(
        se3_exp(vector(0, 0, 0, math.pi, 0, 0))[:3, 2], vector(0, 0, -1), atol=1e-15, rtol=0
    )


def test_the_docstring_still_states_each_convention():
    text = minislam.geometry.__doc__
    for heading in (
        "Frames",
        "Camera",
        "Pixels",
        "Tangent vectors",
        "Quaternions",
        "Images",
        "Units",
    ):
        assert f"\n{heading}\n" in text
