"""The checks of notebook 01: right answers pass, known mistakes are named."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks import check_reproject, check_resized_intrinsics, check_warped_photo
from minislam.geometry import Camera, se3_inverse, transform_points
from tests.helpers import assert_graded, assert_variants


def resized(camera: Camera, width: int, height: int) -> Tensor:
    su, sv = width / camera.width, height / camera.height
    cx, cy = (camera.cx + 0.5) * su - 0.5, (camera.cy + 0.5) * sv - 0.5
    return torch.tensor([camera.fx * su, camera.fy * sv, cx, cy], dtype=torch.float64)


def reprojected(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
    return camera.project(transform_points(pose, camera.backproject(pixels, 1 / disparities)))


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_resized_intrinsics, resized)
    assert_graded(check_reproject, reprojected)


def test_known_mistakes_are_named():
    verdict = check_resized_intrinsics(lambda c, w, h: torch.tensor(
        [c.fx * w / c.width, c.fy * h / c.height, c.cx * w / c.width, c.cy * h / c.height]
    ))  # fmt: skip
    assert "The image starts at -0.5" in verdict.sentence
    assert "for twice the size element [2] is 82.6, expected 83.1" in verdict.sentence
    inverse = check_reproject(lambda p, d, c, pose: reprojected(p, d, c, se3_inverse(pose)))
    assert "inverse motion" in inverse.sentence
    depth = check_reproject(lambda p, d, c, pose: reprojected(p, 1 / d, c, pose))
    assert "depth = 1 / disparity" in depth.sentence


def warped(photo: Tensor, depth: Tensor, camera: Camera, pose: Tensor, flaw: str = "") -> Tensor:
    height, width = depth.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], -1)
    rays = torch.cat([rays, torch.ones_like(rays[..., :1])], -1).to(depth)
    points = depth[..., None] * rays @ pose[:3, :3].T + pose[:3, 3]
    z = points[..., 2]
    u = camera.fx * points[..., 0] / z + camera.cx
    v = camera.fy * points[..., 1] / z + camera.cy
    seen = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    if flaw == "open":
        seen = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    seen &= (z > 0) | (flaw == "behind")
    left, top = u.floor().clamp(0, width - 2).long(), v.floor().clamp(0, height - 2).long()
    a, b = (u - left)[..., None], (v - top)[..., None]
    a, b = (1 - a, 1 - b) if flaw == "turned" else (a, b)
    if flaw == "rounded":
        a, b = a.round(), b.round()
    upper = (1 - a) * photo[top, left] + a * photo[top, left + 1]
    lower = (1 - a) * photo[top + 1, left] + a * photo[top + 1, left + 1]
    color = (1 - b) * upper + b * lower
    return color if flaw == "unmasked" else torch.where(seen[..., None], color, 0)


def warped_in_loops(photo: Tensor, depth: Tensor, camera: Camera, pose: Tensor) -> np.ndarray:
    image, turn, shift = np.zeros(photo.shape), pose[:3, :3].numpy(), pose[:3, 3].numpy()
    for v, u in np.ndindex(depth.shape):
        ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        x, y, z = turn @ (ray * float(depth[v, u])) + shift
        at = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if z > 0 and 0 <= at[0] <= camera.width - 1 and 0 <= at[1] <= camera.height - 1:
            for i, j in np.ndindex(photo.shape[:2]):  # each pixel has a tent as its weight
                weight = max(0, 1 - abs(at[0] - j)) * max(0, 1 - abs(at[1] - i))
                if weight > 0:
                    image[v, u] += weight * photo[i, j].numpy()
    return image


def sampled(
    photo: Tensor, depth: Tensor, camera: Camera, pose: Tensor, align_corners: bool
) -> Tensor:
    pixels = camera.pixel_grid(dtype=depth.dtype)
    points = camera.backproject(pixels, depth) @ pose[:3, :3].T + pose[:3, 3]
    last = points.new_tensor([camera.width - 1, camera.height - 1])
    at = 2 * camera.project(points)[None] / last - 1
    image = functional.grid_sample(photo.permute(2, 0, 1)[None], at, align_corners=align_corners)
    return image[0].permute(1, 2, 0)


@pytest.mark.ex01_3
def test_a_warped_photo_is_told_from_a_wrong_one():
    wrong = {
        "inverse motion": lambda *a: warped(*a[:3], se3_inverse(a[3])),
        "for a disparity": lambda *a: warped(a[0], 1 / a[1], *a[2:]),
        "behind the source camera": partial(warped, flaw="behind"),
        "mix the four": partial(warped, flaw="rounded"),
        "weights are exchanged": partial(warped, flaw="turned"),
        "upside down": lambda *a: warped(*a).flip(0),
        "without the border": partial(warped, flaw="open"),
        "not masked": partial(warped, flaw="unmasked"),
    }
    assert_variants(check_warped_photo, {"one": warped, "other": warped_in_loops}, wrong)
    assert "does not fade" in check_warped_photo(partial(sampled, align_corners=True)).hint
