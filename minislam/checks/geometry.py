"""Exercises of notebook 01."""

from collections.abc import Callable

from torch import Tensor

from minislam.checks.grading import CAMERA, Case, Verdict, check_function, doubles
from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points


def check_resized_intrinsics(student: Callable[[Camera, int, int], Tensor]) -> Verdict:
    """Check (camera, width, height) -> (fx, fy, cx, cy) of the resized image."""

    def reference(camera: Camera, width: int, height: int) -> Tensor:
        resized = camera.resized(width, height)
        return doubles(resized.fx, resized.fy, resized.cx, resized.cy)

    def only_scaled(camera: Camera, width: int, height: int) -> Tensor:
        su, sv = width / camera.width, height / camera.height
        return doubles(camera.fx * su, camera.fy * sv, camera.cx * su, camera.cy * sv)

    cases = [
        Case((CAMERA, 101, 53), "the same size"),
        Case((CAMERA, 202, 106), "twice the size"),
        Case((CAMERA, 33, 26), "33 x 26 pixels"),
    ]
    hint = "This is cx * s: the image starts at -0.5, so scale cx + 0.5 and take 0.5 off again."
    return check_function(student, reference, cases, hints=[(only_scaled, hint)])


def check_reproject(student: Callable[[Tensor, Tensor, Camera, Tensor], Tensor]) -> Verdict:
    """Check (pixels, disparities, camera, T_target_source) -> pixels in the target view."""
    pixels = doubles([0.0, 0.0], [100.0, 52.0], [60.5, 10.25])
    disparities = doubles(0.5, 0.25, 1.0)

    def reference(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        points = camera.backproject(pixels, 1 / disparities)
        return camera.project(transform_points(pose, points))

    def inverted_pose(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        return reference(pixels, disparities, camera, se3_inverse(pose))

    def disparity_as_depth(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor):
        return reference(pixels, 1 / disparities, camera, pose)

    motions = {
        "a camera that stands still": doubles(0, 0, 0, 0, 0, 0),
        "a step of 0.2": doubles(0.2, 0, 0, 0, 0, 0),
        "any motion": doubles(0.1, -0.2, 0.3, 0.1, 0.2, -0.1),
    }
    cases = [Case((pixels, disparities, CAMERA, se3_exp(xi)), name) for name, xi in motions.items()]
    hints = [
        (inverted_pose, "This is the inverse motion: T_target_source takes points to the target."),
        (disparity_as_depth, "This takes the disparity for the depth: depth = 1 / disparity."),
    ]
    return check_function(student, reference, cases, hints=hints)
