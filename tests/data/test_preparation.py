"""Undistort, cut, resize and crop: the camera must follow the image exactly."""

import numpy as np
import pytest
import torch

from minislam.data.preparation import (
    ImagePreparation,
    seen_window,
    working_size,
)
from minislam.errors import InputError
from minislam.geometry import BrownDistortion, Camera

NO_DISTORTION = BrownDistortion()
FR1 = Camera(517.3, 516.5, 318.6, 255.3, 640, 480)
FR1_DISTORTION = BrownDistortion(0.2624, -0.9531, -0.0054, 0.0026, 1.1633)

WHOLE = (0, 0, 640, 480)

# Known answers


@pytest.mark.parametrize(
    "raw, chosen",
    [
        ((640, 480), (320, 240)),
        ((480, 640), (240, 320)),  # portrait stays portrait
        ((1280, 720), (368, 208)),
        ((854, 480), (368, 208)),
        ((320, 240), (320, 240)),
        ((100, 60), (96, 56)),  # never larger than the source
        ((17, 23), (16, 16)),
    ],
)
def test_working_size(raw: tuple[int, int], chosen: tuple[int, int]):
    assert working_size(*raw, 320 * 240) == chosen


def test_nothing_to_do_changes_nothing():
    raw = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    camera = Camera(270, 270, 160, 118, 320, 240)
    prepare = ImagePreparation(camera, NO_DISTORTION, None, 320 * 240)
    assert prepare.camera == camera
    np.testing.assert_array_equal(prepare.color(raw), raw.astype(np.float32) / np.float32(255))
    assert prepare.color(raw).dtype == np.float32
    np.testing.assert_array_equal(prepare.nearest(raw[..., 0]), raw[..., 0])


# Identities


@pytest.mark.parametrize("size", [None, (64, 64), (160, 40), (320, 96)])
def test_a_bright_spot_stays_where_the_camera_projects_it(size: tuple[int, int] | None):
    # The centroid of a smooth spot survives area resampling, so it must be where the working
    # camera projects the same ray.
    width, height, spot = 200, 148, (103.2, 77.7)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    bright = np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / (2 * 6.0**2))
    raw = np.repeat(np.round(255 * bright)[..., None], 3, 2).astype(np.uint8)
    raw_camera = Camera(170, 175, 95, 70, width, height)
    prepare = ImagePreparation(raw_camera, NO_DISTORTION, size, 80 * 60)
    image = prepare.color(raw)[..., 0].astype(np.float64)
    camera = prepare.camera
    assert image.shape == (camera.height, camera.width)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    centroid = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
    ray = raw_camera.rays(torch.tensor(spot, dtype=torch.float64))
    np.testing.assert_allclose(centroid, camera.project(ray).numpy(), atol=0.03)


def test_depth_and_mask_values_are_never_blended():
    raw = np.random.default_rng(1).integers(1, 9, (60, 90)).astype(np.float32)
    prepare = ImagePreparation(Camera(80, 80, 44, 30, 90, 60), NO_DISTORTION, (40, 24), 1)
    assert set(np.unique(prepare.nearest(raw))) <= set(np.unique(raw))
    assert prepare.nearest(raw > 4).dtype == bool
    np.testing.assert_array_equal(prepare.nearest(raw > 4), prepare.nearest(raw) > 4)


def test_nearest_takes_the_pixel_under_the_centre():
    # Halving an even number of pixels: centre k lies at 2k + 0.5 of the raw image.
    raw = np.tile(np.arange(64, dtype=np.float32), (32, 1))
    prepare = ImagePreparation(Camera(50, 50, 31, 15, 64, 32), NO_DISTORTION, (32, 16), 1)
    assert np.abs(prepare.nearest(raw)[0] - (2 * np.arange(32) + 0.5)).max() == 0.5


def test_undistorted_depth_and_colour_show_the_same_place():
    ramp = np.tile(np.arange(640), (480, 1))
    prepare = ImagePreparation(FR1, FR1_DISTORTION, None, 640 * 480)
    color = prepare.color(np.repeat((ramp * 255 / 640)[..., None], 3, 2).astype(np.uint8))
    depth = prepare.nearest(ramp.astype(np.float32))
    assert np.abs(color[..., 0] * 640 - depth).max() < 5


def test_no_black_border_remains_after_undistortion():
    white = np.full((480, 640, 3), 255, np.uint8)
    prepare = ImagePreparation(FR1, FR1_DISTORTION, None, 320 * 240)
    assert prepare.color(white).min() == 1.0
    assert prepare.nearest(np.ones((480, 640), np.float32)).min() == 1.0
    window = seen_window(*FR1_DISTORTION.undistortion_maps(FR1), WHOLE)
    assert window[2] * window[3] > 0.85 * 640 * 480


def test_no_black_bar_remains_after_undistortion():
    letterboxed = np.full((480, 640, 3), 255, np.uint8)
    letterboxed[:60] = letterboxed[-60:] = 0
    how = FR1, FR1_DISTORTION, None, 640 * 480
    barred, whole = ImagePreparation(*how, (0, 60, 640, 360)), ImagePreparation(*how)
    assert barred.color(letterboxed).min() == 1.0 and whole.color(letterboxed).min() == 0.0
    assert 300 < barred.camera.height < 360
    # The same camera: what is cut moves the principal point alone.
    left, top = (barred.steps["window"][k] - whole.steps["window"][k] for k in (0, 1))
    before, after = whole.full_camera(whole.camera), barred.full_camera(barred.camera)
    found = after.cx + left, after.cy + top, after.fx, after.fy
    np.testing.assert_allclose(found, (before.cx, before.cy, before.fx, before.fy), atol=1e-9)


# Errors


def test_tiny_images_are_refused():
    with pytest.raises(InputError, match="1x1"):
        ImagePreparation(Camera(1, 1, 0, 0, 1, 1), NO_DISTORTION, None, 100)


def test_a_distortion_that_leaves_nothing_is_refused():
    maps = np.full((48, 64), -1, np.float32), np.full((48, 64), -1, np.float32)
    with pytest.raises(InputError, match="check k1 k2 p1 p2 k3"):
        seen_window(*maps, WHOLE)


@pytest.mark.parametrize("k3", [1e308, -1e308])
def test_an_absurd_distortion_is_refused(k3: float):
    with pytest.raises(InputError, match="check k1 k2 p1 p2 k3"):
        ImagePreparation(FR1, BrownDistortion(k1=0.1, k3=k3), None, 100)
