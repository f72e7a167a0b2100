"""Exercises of notebook 01."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function
from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points


def check_resized_intrinsics(student: Callable[[Camera, int, int], Tensor]) -> Verdict:
    """Check (camera, width, height) -> (fx, fy, cx, cy) of the resized image."""
    camera = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)

    def reference(camera: Camera, width: int, height: int) -> Tensor:
        resized = camera.resized(width, height)
        return torch.tensor([resized.fx, resized.fy, resized.cx, resized.cy], dtype=torch.float64)

    def only_scaled(camera: Camera, width: int, height: int) -> Tensor:
        su, sv = width / camera.width, height / camera.height
        values = [camera.fx * su, camera.fy * sv, camera.cx * su, camera.cy * sv]
        return torch.tensor(values, dtype=torch.float64)

    cases = [
        Case((camera, 101, 53), "the same size"),
        Case((camera, 202, 106), "twice the size"),
        Case((camera, 33, 26), "33 x 26 pixels"),
    ]
    hint = "This is cx * s: the image starts at -0.5, so scale cx + 0.5 and take 0.5 off again."
    return check_function(student, reference, cases, hints=[(only_scaled, hint)])


def check_reproject(student: Callable[[Tensor, Tensor, Camera, Tensor], Tensor]) -> Verdict:
    """Check (pixels, disparities, camera, T_target_source) -> pixels in the target view."""
    camera = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)
    pixels = torch.tensor([[0.0, 0.0], [100.0, 52.0], [60.5, 10.25]], dtype=torch.float64)
    disparities = torch.tensor([0.5, 0.25, 1.0], dtype=torch.float64)

    def reference(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        points = camera.backproject(pixels, 1 / disparities)
        return camera.project(transform_points(pose, points))

    def inverted_pose(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        return reference(pixels, disparities, camera, se3_inverse(pose))

    def disparity_as_depth(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor):
        return reference(pixels, 1 / disparities, camera, pose)

    def motion(*xi: float) -> Tensor:
        return se3_exp(torch.tensor(xi, dtype=torch.float64))

    cases = [
        Case((pixels, disparities, camera, motion(0, 0, 0, 0, 0, 0)), "a camera that stands still"),
        Case((pixels, disparities, camera, motion(0.2, 0, 0, 0, 0, 0)), "a step of 0.2"),
        Case((pixels, disparities, camera, motion(0.1, -0.2, 0.3, 0.1, 0.2, -0.1)), "any motion"),
    ]
    hints = [
        (inverted_pose, "This is the inverse motion: T_target_source takes points to the target."),
        (disparity_as_depth, "This takes the disparity for the depth: depth = 1 / disparity."),
    ]
    return check_function(student, reference, cases, hints=hints)
