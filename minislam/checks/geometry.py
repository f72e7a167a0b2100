"""Exercises of notebook 01."""

from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks.cases import CAMERA, Case, any_pose, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points


def check_resized_intrinsics(student: Function) -> Verdict:
    """Check (camera, width, height) -> (fx, fy, cx, cy) of the resized image."""

    def reference(camera: Camera, width: int, height: int) -> Tensor:
        resized = camera.resized(width, height)
        return doubles(resized.fx, resized.fy, resized.cx, resized.cy)

    def shifted(before: float, after: float, camera: Camera, width: float, height: float) -> Tensor:
        su, sv = width / camera.width, height / camera.height
        cx, cy = (camera.cx + before) * su + after, (camera.cy + before) * sv + after
        return doubles(camera.fx * su, camera.fy * sv, cx, cy)

    def case(width: int, height: int, description: str = "") -> Case:
        return Case((CAMERA, width, height), description or f"{width} x {height} pixels")

    cases = [case(101, 53, "the same size"), case(202, 106, "twice the size"), case(33, 26)]
    cases += drawn(lambda seed: case(20 + 37 * seed % 300, 30 + 23 * seed % 200))
    right = partial(shifted, 0.5, -0.5)
    mistakes = [
        (lambda *a: shifted(0, 0, *a), "The image starts at -0.5: (cx + 0.5) * scale - 0.5."),
        (lambda *a: shifted(-0.5, 0.5, *a), "The image starts at -0.5: both signs are wrong."),
        (lambda *a: shifted(0.5, 0, *a), "Take 0.5 off after scaling: it starts at -0.5, too."),
        (lambda *a: shifted(0, -0.5, *a), "Add 0.5 before scaling, as it is taken off later."),
        (lambda c, w, h: reference(c, w, h)[[0, 2, 1, 3]], "The order is fx, fy, cx, cy."),
        (lambda c, _, h: right(c, c.width * h / c.height, h), "Width and height: a scale each."),
        (lambda c, w, h: right(c, c.width**2 / w, c.height**2 / h), "Scale by new over old size."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_reproject(student: Function) -> Verdict:
    """Check (pixels, disparities, camera, T_target_source) -> pixels in the target view."""

    def reference(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        return camera.project(transform_points(pose, camera.backproject(pixels, 1 / disparities)))

    def case(twist: Tensor, description: str, seed: int = 0) -> Case:
        pixels = doubles(50, 25) + 15 * normals(seed, 4, 2)
        disparities = 0.2 + 0.3 * normals(seed, 4).abs()
        return Case((pixels, disparities, CAMERA, se3_exp(twist)), description)

    cases = [
        case(doubles(0, 0, 0, 0, 0, 0), "a camera that stands still"),
        case(doubles(0.2, 0, 0, 0, 0, 0), "a step of 0.2"),
        case(doubles(0.1, -0.2, 0.3, 0.1, 0.2, -0.1), "any motion"),
        *drawn(lambda seed: case(0.1 * normals(seed, 6), "4 pixels", seed)),
    ]
    mistakes = [
        (lambda p, d, c, T: reference(p, d, c, se3_inverse(T)), "This is the inverse motion."),
        (lambda p, d, *a: reference(p, 1 / d, *a), "These are no depths: depth = 1 / disparity."),
        (lambda p, d, *a: reference(p, d**0, *a), "The disparities are not used: depth is 1."),
        (lambda p, d, *a: reference(p, 1e-12 * d, *a), "The translation is missing."),
        (lambda *a: reference(*a).flip(-1), "u and v are exchanged: a pixel is (column, row)."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_warped_photo(student: Function) -> Verdict:
    """Check (photo, depth, camera, T_source_target) -> the photo as the target sees it."""
    photo, depth = normals(0, 13, 17, 3).abs(), 1 + normals(1, 13, 17).abs()
    scene = photo, depth, Camera(20.0, 24.0, 8.3, 5.8, 17, 13)
    exact = photo, 0 * depth + 2, Camera(16.0, 16.0, 8.0, 6.0, 17, 13)  # no number is rounded

    def warped(*view: Any, flaw: str = "") -> Tensor:
        photo, depth, camera, pose = view
        pixels = camera.pixel_grid(dtype=depth.dtype)
        points = camera.backproject(pixels, 1 / depth if flaw == "disparity" else depth)
        pose = se3_inverse(pose) if flaw == "inverted" else pose
        points = transform_points(pose, points.flatten(0, 1)).view(points.shape)
        pixels, last = camera.project(points), doubles(camera.width - 1, camera.height - 1)
        inside = ((pixels >= 0) & (pixels <= last)).all(-1)
        seen = inside & ((points[..., 2] > 0) | (flaw == "behind")) | (
            flaw in ("unmasked", "faded")
        )
        pixels = 2 * pixels.floor() + 1 - pixels if flaw == "turned" else pixels
        position = (2 * (pixels.round() if flaw == "rounded" else pixels) / last - 1)[None]
        planes, position = photo.permute(2, 0, 1)[None], position.to(photo)
        beyond = "zeros" if flaw == "faded" else "border"
        sampled = functional.grid_sample(planes, position, "bilinear", beyond, True)
        return torch.where(seen[..., None], sampled[0].permute(1, 2, 0), 0)

    cases = [
        Case((*scene, se3_exp(doubles(0.2, -0.07, 0.1, 0, 0, 0))), "a small step"),
        Case((*scene, se3_exp(doubles(0.1, -0.2, 0.3, 0.1, 0.2, -0.1))), "any motion"),
        Case((*scene, se3_exp(doubles(0.1, 0, 0, 0, 3.0, 0))), "a source camera that looks back"),
        Case((*exact, torch.eye(4).double()), "a source camera in the same place"),
        *drawn(lambda seed: Case((*scene, any_pose(seed)), f"motion {seed}")),
    ]
    mistakes = [
        ("inverted", "This is the inverse motion: T_source_target takes points to the source."),
        ("disparity", "This takes the depth for a disparity: the point is depth times the ray."),
        ("behind", "Points behind the source camera (z <= 0) are not in its photo."),
        ("unmasked", "Where the source sees nothing it is 0: outside its photo, or behind."),
        ("faded", "Outside, and behind, it is 0 at once: the border does not fade (grid_sample)."),
        ("rounded", "This takes the nearest pixel: mix the four around the position."),
        ("turned", "The weights are exchanged: the nearer of two pixels has the larger weight."),
    ]
    return check_function(student, warped, cases, 1e-9, mistakes)
