"""Exercises of notebook 02."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import CAMERA, Case, Verdict, check_function, doubles, drawn, normals
from minislam.geometry import Camera, se3_exp, transform_points
from minislam.splatting.constants import LOW_PASS_VARIANCE, NEAR_DEPTH
from minislam.splatting.reference import composite, gaussian_alphas, project_covariances


def check_projected_covariance(student: Callable[..., Tensor]) -> Verdict:
    """Check (covariance_world, mean_world, T_camera_world, camera) -> Sigma' (2, 2) in px^2."""

    def reference(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        point = transform_points(pose, mean[None])
        return project_covariances(covariance[None], point, pose, camera)[0]

    def turned(times: int, covariance: Tensor, mean: Tensor, pose: Tensor, *a: Camera) -> Tensor:
        back = torch.linalg.matrix_power(pose[:3, :3].T, times)
        return reference(back @ covariance @ back.T, mean, pose, *a)

    def case(x: float, turn: float, description: str, seed: int = 0) -> Case:
        factor = doubles([0.3, 0.1, 0.0], [0.0, 0.2, 0.1], [0.1, 0.0, 0.05])
        factor = factor + 0.03 * normals(seed, 3, 3)
        pose = se3_exp(doubles(0.1, -0.1, 0.2, turn, -turn, 0.5 * turn))
        return Case((factor @ factor.T, doubles(x, 0.1, 2.5), pose, CAMERA), description)

    def draw(seed: int) -> Case:
        x, turn = normals(seed, 2).clamp(-2, 2).tolist()
        return case(0.3 * x, 0.15 * turn, "any camera", seed)

    cases = [
        case(-0.1, 0.0, "a camera that is not turned"),
        case(0.6, 0.2, "a turned camera"),
        *drawn(draw),
    ]
    low_pass = LOW_PASS_VARIANCE * torch.eye(2).double()
    off_diagonal = LOW_PASS_VARIANCE - low_pass
    hints = [
        (lambda *a: reference(*a) - low_pass, "The low-pass filter is missing: add 0.3 I."),
        (lambda *a: turned(1, *a), "Sigma is still in the world frame: turn it by W before J."),
        (lambda *a: turned(2, *a), "This turns Sigma the wrong way: it is W Sigma W^T."),
        (lambda *a: reference(*a) + off_diagonal, "0.3 stands on the diagonal alone: 0.3 I."),
        (lambda *a: torch.linalg.inv(reference(*a)), "This is the conic, the inverse of Sigma'."),
        (
            lambda S, x, *a: project_covariances(S[None], x[None], *a)[0],
            "J is taken at the world point: move the mean into the camera frame first.",
        ),
    ]
    return check_function(student, reference, cases, 1e-9, hints)


def check_pixel_color(student: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (alphas, colors, background) -> color (3,) of one pixel, nearest Gaussian first."""

    def blended(alphas: Tensor, colors: Tensor, background: Tensor, flaw: str = "") -> Tensor:
        light = torch.cat([alphas.new_ones(1), (1 - alphas).cumprod(0)])  # (K + 1,)
        end = {"unattenuated": 1, "no background": 0}.get(flaw, light[-1])
        if flaw == "sum":
            light = torch.cat([light[:1], 1 - alphas.cumsum(0)])
            end = light[-1]
        before = {"itself": light[1:], "unshaded": light[:-1] ** 0}.get(flaw, light[:-1])
        return (before * alphas ** (flaw != "opaque")) @ colors + end * background

    def draw(seed: int) -> Case:
        values = normals(seed, 5, 4).sigmoid()[: 1 + seed % 5]
        description = f"a list of {len(values)}, on blue"
        return Case((values[:, 0], values[:, 1:], doubles(0.1, 0.2, 0.9)), description)

    colors = doubles([0.9, 0.1, 0.2], [0.3, 0.8, 0.4], [0.2, 0.5, 1.0])
    alphas = doubles(0.3, 0.6, 0.5)
    grey = doubles(0.6, 0.6, 0.6)
    cases = [
        Case((alphas, colors, torch.zeros_like(grey)), "three Gaussians on black"),
        Case((alphas, colors, grey), "three Gaussians on grey"),
        Case((alphas[:0], colors[:0], grey), "no Gaussian at all"),
        *drawn(draw),
    ]
    flaws = {
        "no background": "The background is missing: add T_end times its colour.",
        "itself": "T_i holds only the Gaussians in front of i, not i itself.",
        "unattenuated": "The background shines through T_end only: multiply it.",
        "opaque": "Each colour counts T_i times its own alpha_i.",
        "sum": "The light that is left is a product of (1 - alpha), not 1 minus a sum.",
        "unshaded": "T_i is missing: what stands in front takes light away.",
    }
    farthest = "This starts with the farthest: the list is sorted nearest first."
    hints = [(lambda a, c, b: blended(a.flip(0), c.flip(0), b), farthest)]
    return check_function(student, blended, cases, 1e-9, hints, flaws)


def check_rendered_image(student: Callable[..., Tensor]) -> Verdict:
    """Check (means, covariances, opacities, colors, T_camera_world, camera) -> image (H, W, 3)."""
    factors, colors = normals(1, 2, 5, 3, 3)
    means = doubles([0.1, 0, 3], [0, 0.1, 2], [-0.2, -0.1, 4], [0.3, 0, -2], [-0.3, 0.2, 2.5])
    values = (means, 0.1 * factors @ factors.mT, doubles(0.8, 0.6, 0.9, 0.7, 1), colors[:, 0].abs())

    def rendered(*view: Any, flaw: str = "") -> Tensor:
        means, covariances, opacities, colors, pose, camera = view
        points = transform_points(pose, means)
        kept = ((points[:, 2] > NEAR_DEPTH) | (flaw == "behind")).nonzero()[:, 0]
        if flaw != "unsorted":
            kept = kept[points[kept, 2].argsort(descending=flaw == "far first")]
        wide = project_covariances(covariances[kept], points[kept], pose, camera)
        wide = wide - (flaw == "sharp") * LOW_PASS_VARIANCE * torch.eye(2, dtype=wide.dtype)
        wide = wide / 2 if flaw == "whole" else wide
        alphas = gaussian_alphas(camera.project(points[kept]), wide, opacities[kept], camera)
        if flaw == "added":
            return torch.einsum("nhw,nc->hwc", alphas, colors[kept])
        return composite(alphas, colors[kept], torch.zeros_like(colors[0]))[0]

    def draw(seed: int) -> Case:
        pose = se3_exp(0.1 * normals(seed, 6))
        return Case((*values, pose, camera), f"five Gaussians and pose {seed}")

    camera = Camera(18.0, 22.0, 9.3, 6.8, 21, 13)
    turned = se3_exp(doubles(0.1, -0.1, 0.2, 0.1, -0.2, 0.3))
    cases = [
        Case((*(x[:1] for x in values), se3_exp(doubles(*[0] * 6)), camera), "one Gaussian"),
        Case((*(x[:3] for x in values), turned, camera), "three Gaussians in any order"),
        Case((*values, turned, camera), "five Gaussians, one behind the camera"),
        *drawn(draw),
    ]
    flaws = {
        "unsorted": "Sort by the depth in the camera frame: the list has no order.",
        "far first": "This is sorted the wrong way: the nearest Gaussian comes first.",
        "behind": "A Gaussian behind the camera (z < 0.05) is not seen: leave it out.",
        "sharp": "The low-pass filter is missing: add 0.3 I to Sigma'.",
        "whole": "The exponent is -1/2 of the squared distance.",
        "added": "Light is used up on its way: multiply T by 1 - alpha after each Gaussian.",
    }
    return check_function(student, rendered, cases, 1e-6, flaws=flaws)
