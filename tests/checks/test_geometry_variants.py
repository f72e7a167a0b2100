"""Right and wrong answers to the exercises of notebook 01."""

import pytest
import torch

from minislam.checks import check_reproject, check_resized_intrinsics
from minislam.geometry import se3_inverse, transform_points
from tests.helpers import assert_variants


def resized(before=0.5, after=-0.5, order=(0, 1, 2, 3)):
    def answer(camera, width, height):
        su, sv = width / camera.width, height / camera.height
        cx, cy = (camera.cx + before) * su + after, (camera.cy + before) * sv + after
        values = camera.fx * su, camera.fy * sv, cx, cy
        return [values[i] for i in order]

    return answer


def inverse_scale(camera, width, height):
    return resized()(camera, camera.width**2 / width, camera.height**2 / height)


def one_scale(camera, width, height):
    s = height / camera.height
    return [camera.fx * s, camera.fy * s, (camera.cx + 0.5) * s - 0.5, (camera.cy + 0.5) * s - 0.5]


def of_the_package(camera, width, height):
    small = camera.resized(width, height)
    return torch.tensor([small.fx, small.fy, small.cx, small.cy])  # float32


@pytest.mark.ex01_1
def test_resized_intrinsics():
    right = {"list": resized(), "float32": of_the_package}
    wrong = {
        "only scaled": resized(0, 0),
        "both signs": resized(-0.5, 0.5),
        "half a pixel stays": resized(0.5, 0),
        "half a pixel off": resized(0, -0.5),
        "focal length, centre": resized(order=(0, 2, 1, 3)),
        "centre first": resized(order=(2, 3, 0, 1)),
        "inverse scale": inverse_scale,
        "one scale": one_scale,
        "focal lengths kept": lambda c, w, h: [c.fx, c.fy, *resized()(c, w, h)[2:]],
    }
    assert_variants(check_resized_intrinsics, right, wrong)


def moved(pixels, disparities, camera, T):
    return camera.project(transform_points(T, camera.backproject(pixels, 1 / disparities)))


def by_hand(pixels, disparities, camera, T):
    positions = []
    for (u, v), d in zip(pixels.tolist(), disparities.tolist(), strict=True):
        point = [(u - camera.cx) / camera.fx / d, (v - camera.cy) / camera.fy / d, 1 / d, 1]
        x, y, z, _ = (T @ torch.tensor(point)).tolist()
        positions.append((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy))
    return positions


def with_scaled_points(pixels, disparities, camera, T):
    X = camera.rays(pixels) @ T[:3, :3].T + disparities[:, None] * T[:3, 3]
    return X[:, :2] / X[:, 2:] * X.new_tensor([camera.fx, camera.fy]) + X.new_tensor(
        [camera.cx, camera.cy]
    )


def turned(pixels, disparities, camera, T):
    points = camera.backproject(pixels, 1 / disparities)
    return camera.project(points @ T[:3, :3].T)


def unturned(pixels, disparities, camera, T):
    return camera.project(camera.backproject(pixels, 1 / disparities) + T[:3, 3])


@pytest.mark.ex01_2
def test_reproject():
    right = {"by hand": by_hand, "X = R r + d t": with_scaled_points}
    wrong = {
        "inverse": lambda p, d, c, T: moved(p, d, c, se3_inverse(T)),
        "disparity as depth": lambda p, d, c, T: moved(p, 1 / d, c, T),
        "depth 1": lambda p, d, c, T: moved(p, torch.ones_like(d), c, T),
        "no translation": turned,
        "no rotation": unturned,
        "rows and columns": lambda *a: moved(*a).flip(1),
        "transposed": lambda *a: moved(*a).T,
        "nothing moves": lambda p, d, c, T: p,
        "three numbers": lambda p, d, c, T: c.backproject(p, 1 / d),
    }
    assert_variants(check_reproject, right, wrong)
