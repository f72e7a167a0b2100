"""Cameras and frames of the generator."""

import numpy as np
import pytest

from data_synth.poses import default_intrinsics, frame_along, look_at, upright


def test_the_reference_camera_has_a_focal_length_of_272_px():
    camera = default_intrinsics((320, 240))
    assert (camera.fx, camera.fy) == (272.0, 272.0)
    assert 1 < abs(camera.cx - 159.5) < 16 and abs(camera.cy - 119.5) < 12  # off the middle


def test_resizing_maps_pixel_centres_to_pixel_centres():
    # Resizing by s maps a coordinate c to (c + 0.5) s - 0.5.
    full, half = default_intrinsics((320, 240)), default_intrinsics((160, 120))
    assert half.fx == full.fx / 2
    assert half.cx == pytest.approx((full.cx + 0.5) / 2 - 0.5)
    assert half.cy == pytest.approx((full.cy + 0.5) / 2 - 0.5)


def test_a_camera_that_looks_along_y_has_x_right_and_y_down():
    T_world_camera = look_at(np.zeros(3), np.array([0.0, 5.0, 0.0]))
    np.testing.assert_allclose(T_world_camera[:3, :3], np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))


def test_a_limb_runs_between_its_joints():
    start, end = np.array([0.1, 0.2, 0.3]), np.array([0.5, -0.1, 1.0])
    T_world_limb = frame_along(start, end, np.array([1.0, 0, 0]))
    half = np.linalg.norm(end - start) / 2
    np.testing.assert_allclose((T_world_limb @ [0, 0, half, 1])[:3], end)
    np.testing.assert_allclose((T_world_limb @ [0, 0, -half, 1])[:3], start)
    np.testing.assert_allclose(T_world_limb[:3, :3].T @ T_world_limb[:3, :3], np.eye(3), atol=1e-12)


def test_upright_things_turn_about_the_vertical():
    T_world_thing = upright([1.0, 2.0, 3.0], np.pi / 2)
    np.testing.assert_allclose(T_world_thing @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
