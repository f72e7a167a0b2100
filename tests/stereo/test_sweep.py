"""The plane sweep: its homographies, and where its cost is least."""

import numpy as np
import pytest
import torch

from minislam.geometry import Camera, se3_exp
from minislam.stereo.sweep import (
    UNSEEN_COST,
    PosedImage,
    _mean_of_better_half,
    plane_homographies,
    sweep,
    warp,
)

CAMERA = Camera(fx=60.0, fy=66.0, cx=33.0, cy=19.0, width=80, height=56)


def texture(seed: int = 0, width: int = 160) -> np.ndarray:
    noise = np.random.default_rng(seed).random((56, width))
    return ((noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3).astype(np.float32)


def sideways(distance: float) -> np.ndarray:
    """Return T_camera_world of a camera that has moved to the right."""
    pose = np.eye(4)
    pose[0, 3] = -distance
    return pose


def wall_seen(shift: int) -> np.ndarray:
    """Return a wall as seen by a camera that has moved so far that the wall shifts by pixels."""
    return np.ascontiguousarray(texture()[:, 20 + shift : 100 + shift])


def test_a_homography_projects_the_points_of_its_plane():
    T = se3_exp(torch.tensor([0.2, -0.1, 0.3, 0.05, -0.1, 0.08], dtype=torch.float64)).numpy()
    pixels = np.random.default_rng(2).uniform(0, 50, (10, 2))
    for q in (0.0, 0.1, 0.4):
        H = plane_homographies(CAMERA, T, np.array([q]))[0]
        mapped = np.c_[pixels, np.ones(10)] @ H.T
        rays = CAMERA.rays(torch.from_numpy(pixels)).numpy()
        points = rays @ T[:3, :3].T + q * T[:3, 3]  # times the inverse depth
        expected = CAMERA.project(torch.from_numpy(points)).numpy()
        np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], expected, atol=1e-9)


@pytest.mark.parametrize("shift", [0, 3, 6])
def test_the_cost_is_least_on_the_plane_of_the_wall(shift: int):
    # A camera that moves by 0.1 sees a wall at inverse depth q shift by 6 q pixels.
    planes = np.arange(10) / 6 * 1.0
    others = [
        PosedImage(wall_seen(shift), sideways(0.1)),
        PosedImage(wall_seen(-shift), sideways(-0.1)),
    ]
    cost = sweep(CAMERA, PosedImage(wall_seen(0), np.eye(4)), others, planes)
    assert cost.shape == (10, 56, 80) and cost.dtype == np.float32
    inner = cost[:, 4:-4, 12:-12]
    assert (inner.argmin(0) == shift).mean() > 0.99
    assert inner[shift].max() < 0.06 and 0 <= cost.min() and cost.max() <= 1


def test_brightness_does_not_decide():
    planes = np.arange(8) / 6
    dimmed = PosedImage(0.7 * wall_seen(4), sideways(0.1))
    cost = sweep(CAMERA, PosedImage(wall_seen(0), np.eye(4)), [dimmed], planes)
    assert (cost[:, 4:-4, 12:-12].argmin(0) == 4).mean() > 0.95


def test_what_nobody_sees_costs_as_much_on_every_plane():
    far = PosedImage(wall_seen(0), sideways(100.0))
    cost = sweep(CAMERA, PosedImage(wall_seen(0), np.eye(4)), [far], np.array([0.5, 1.0]))
    np.testing.assert_allclose(cost, UNSEEN_COST, rtol=1e-6)


def test_a_plane_behind_the_other_camera_is_not_seen():
    ahead = np.eye(4)
    ahead[2, 3] = -2.0  # the other camera stands two units in front of this one
    H = plane_homographies(CAMERA, ahead, np.array([1.0]))[0]
    assert (warp(wall_seen(0), H) < 0).all()


def test_the_worse_half_of_the_views_has_no_say():
    costs = np.array([0.1, 0.2, 0.9, 1.0, 0.8])[:, None, None].astype(np.float32)
    everywhere = np.ones_like(costs, dtype=bool)
    mean = _mean_of_better_half([*costs], everywhere)
    np.testing.assert_allclose(mean, (0.1 + 0.2 + 0.8) / 3, rtol=1e-6)
    unseen = everywhere.copy()
    unseen[0] = False
    np.testing.assert_allclose(_mean_of_better_half([*costs], unseen), 0.5, rtol=1e-6)
    unseen[1:4] = False
    np.testing.assert_allclose(_mean_of_better_half([*costs], unseen), UNSEEN_COST)  # one of five


@pytest.mark.parametrize("views", range(1, 9))
def test_the_better_half_is_that_of_a_sort(views: int):
    source = np.random.default_rng(views)
    costs = source.random((views, 5, 7), np.float32)
    seen = source.random(costs.shape) < 0.8
    mean = _mean_of_better_half([*costs], seen)
    for row, column in np.ndindex(5, 7):
        of_pixel = np.sort(costs[:, row, column][seen[:, row, column]])
        half = of_pixel[: (len(of_pixel) + 1) // 2]
        expected = half.mean() if len(of_pixel) >= max(1, 0.25 * views) else UNSEEN_COST
        np.testing.assert_allclose(mean[row, column], expected, rtol=1e-6)
