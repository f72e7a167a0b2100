"""The checks of notebook 01: right answers pass, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import check_reproject, check_resized_intrinsics
from minislam.geometry import Camera, se3_inverse, transform_points
from tests.helpers import assert_graded


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
    assert "the image starts at -0.5" in verdict.sentence
    assert "for twice the size element [2] is 82.6, expected 83.1" in verdict.sentence
    inverse = check_reproject(lambda p, d, c, pose: reprojected(p, d, c, se3_inverse(pose)))
    assert "inverse motion" in inverse.sentence
    depth = check_reproject(lambda p, d, c, pose: reprojected(p, 1 / d, c, pose))
    assert "depth = 1 / disparity" in depth.sentence
