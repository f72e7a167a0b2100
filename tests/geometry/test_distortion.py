"""Brown's distortion: agreement with OpenCV and with the formula written out."""

import cv2
import numpy as np

from minislam.geometry import BrownDistortion, Camera
from minislam.geometry.distortion import camera_matrix

CAMERA = Camera(258.65, 258.25, 159.3, 127.65, 320, 240)
# The colour camera of the TUM fr1 sequences: strong enough that a wrong order shows.
LENS = BrownDistortion(k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633)


# Known answers


def test_the_maps_follow_the_formula_of_brown():
    u, v = 280, 40
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    r2 = x * x + y * y
    radial = 1 + LENS.k1 * r2 + LENS.k2 * r2**2 + LENS.k3 * r2**3
    x_raw = x * radial + 2 * LENS.p1 * x * y + LENS.p2 * (r2 + 2 * x * x)
    y_raw = y * radial + LENS.p1 * (r2 + 2 * y * y) + 2 * LENS.p2 * x * y
    map_u, map_v = LENS.undistortion_maps(CAMERA)
    assert abs(map_u[v, u] - (CAMERA.fx * x_raw + CAMERA.cx)) < 1e-3
    assert abs(map_v[v, u] - (CAMERA.fy * y_raw + CAMERA.cy)) < 1e-3


def test_the_calibration_matrix_projects_like_the_camera():
    pixel = camera_matrix(CAMERA) @ np.array([0.2, -0.1, 1.0])
    assert np.allclose(pixel, [258.65 * 0.2 + 159.3, 258.25 * -0.1 + 127.65, 1])


# Identities


def test_opencv_undistorts_the_points_of_the_maps_back_to_their_pixels():
    # OpenCV inverts the lens with a few fixed-point steps, which suffice away from the corners.
    map_u, map_v = LENS.undistortion_maps(CAMERA)
    v, u = np.meshgrid(np.arange(60, 200, 20), np.arange(80, 260, 20), indexing="ij")
    raw = np.stack([map_u[v, u], map_v[v, u]], -1).reshape(-1, 1, 2).astype(np.float64)
    matrix = camera_matrix(CAMERA)
    back = cv2.undistortPoints(raw, matrix, LENS.coefficients, P=matrix)[:, 0]
    error = np.abs(back - np.stack([u, v], -1).reshape(-1, 2)).max()
    moved = np.abs(raw[:, 0] - np.stack([u, v], -1).reshape(-1, 2)).max()
    assert moved > 1 and error < 0.01, (moved, error)


def test_without_distortion_the_image_is_unchanged():
    map_u, map_v = BrownDistortion().undistortion_maps(CAMERA)
    v, u = np.meshgrid(np.arange(240), np.arange(320), indexing="ij")
    assert np.abs(map_u - u).max() < 1e-4 and np.abs(map_v - v).max() < 1e-4
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    assert (cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR) == image).all()


def test_the_principal_point_does_not_move():
    camera = Camera(250.0, 250.0, 160.0, 120.0, 320, 240)
    map_u, map_v = LENS.undistortion_maps(camera)
    assert abs(map_u[120, 160] - 160) < 1e-4 and abs(map_v[120, 160] - 120) < 1e-4


def test_beyond_the_fold_of_a_lens_the_maps_point_outside():
    # 1 - 0.9 r^2 is zero at r = 1.054: 168.7 px from the centre.
    camera = Camera(160, 160, 159.5, 119.5, 320, 240)
    map_u, _ = BrownDistortion(k1=-0.3).undistortion_maps(camera)
    v, u = np.meshgrid(np.arange(240) - 119.5, np.arange(320) - 159.5, indexing="ij")
    np.testing.assert_array_equal(map_u == -1, np.hypot(u, v) > 168.7)
    # Near the centre, this lens shows the more the farther out; so does that of TUM everywhere.
    assert (np.diff(map_u[:, 101:219]) > 0).all()
    assert (np.diff(LENS.undistortion_maps(CAMERA)[0]) > 0).all()
