"""Exercises of notebook 07 that build: insertion and loss of a map, and tracking through it."""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import CAMERA, Case, Verdict, check_function, doubles
from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points
from minislam.mapping.config import InsertionConfig, MappingConfig, PoseRefinementConfig
from minislam.mapping.insertion import EXPLAINED_OPACITY, gaussians_at_pixels
from minislam.mapping.losses import METRIC_MEDIAN, render_loss
from minislam.mapping.pose_refinement import refine_pose
from minislam.splatting import GaussianMap, Rendering, render


def random(source: torch.Generator, *shape: int) -> Tensor:
    """Return numbers in [0, 1)."""
    return torch.rand(*shape, generator=source, dtype=torch.float64)


def check_insertion(student: Callable[..., Tensor]) -> Verdict:
    """Check (image, depth, weight, opacity, camera, T_camera_world, cell) -> new Gaussians (n, 7).

    A row is mean, scale, colour: of the middle pixel of each cell, row by row, where the depth is
    known, the weight positive and the map transparent.
    """

    def reference(*a: Any, depth_at_least: float = 1e-9) -> Tensor:
        image, depth, weight, opacity, camera, T, cell = a
        allowed = (depth >= depth_at_least) & (weight > 0) & (opacity < EXPLAINED_OPACITY)
        middle = torch.zeros_like(allowed)
        middle[cell // 2 :: cell, cell // 2 :: cell] = True
        pixels = (allowed & middle).nonzero().flip(-1)
        new = gaussians_at_pixels(pixels, image, depth, camera, T, 0, InsertionConfig(cell))
        return torch.cat([new.means, new.scales[:, :1], new.colors], -1)

    def of_one_size(*a: Any) -> Tensor:
        answer = reference(*a)
        answer[:, 3] /= transform_points(a[5], answer[:, :3])[:, 2]
        return answer

    source = torch.Generator().manual_seed(0)
    shape = CAMERA.height, CAMERA.width
    image, (depth, weight, opacity) = random(source, *shape, 3), random(source, 3, *shape)
    depth = torch.where(random(source, *shape) < 0.1, 0, 1 + 2 * depth)
    weight[20:40, 50:80] = 0
    T = se3_exp(doubles(0.3, -0.1, 0.2, 0.1, -0.2, 0.05))
    start, one, zero = torch.eye(4, dtype=torch.float64), torch.ones(shape), torch.zeros(shape)
    cases = [
        Case((image, 1 + 0 * depth, one, zero, CAMERA, start, 8), "a wall and an empty map"),
        Case((image, 1 + depth, one, zero, CAMERA, T, 5), "a camera that has moved"),
        Case((image, depth, one, zero, CAMERA, T, 4), "depth that is unknown (0) in places"),
        Case((image, depth, weight, zero, CAMERA, T, 4), "a dynamic object, where the weight is 0"),
        Case((image, depth, weight, opacity, CAMERA, T, 3), "a map that covers a part"),
    ]
    corner = replace(CAMERA, cx=0.0, cy=0.0)
    hints = [
        (lambda *a: reference(*a, depth_at_least=0), "Depth 0 means unknown: insert nothing."),
        (lambda i, d, w, *a: reference(i, d, one, *a), "Weight 0 is a dynamic object: leave it."),
        (lambda *a: reference(*a[:3], zero, *a[4:]), "Parts of the map are opaque there already."),
        (lambda *a: reference(*a[:3], 1.6 - a[3], *a[4:]), "Insert where the map is transparent."),
        (lambda *a: reference(*a[:5], se3_inverse(a[5]), a[6]), "From camera to world: T^-1."),
        (lambda *a: reference(*a[:5], start, a[6]), "These means are in the camera's frame."),
        (lambda *a: reference(*a[:4], corner, *a[5:]), "A ray is (u - cx) / fx, (v - cy) / fy, 1."),
        (of_one_size, "A cell at depth z is cell * z / f wide."),
    ]
    return check_function(student, reference, cases, 1e-6, hints)


def check_map_loss(student: Callable[..., Tensor]) -> Verdict:
    """Check (colour, depth, image, reference depth, weight, scales) -> Eq. (6) without SSIM."""
    config = MappingConfig(lambda_ssim=0.0)

    def reference(*a: Tensor, shares: tuple[float, float, float] = (0.8, 0.2, 10.0)) -> Tensor:
        color, depth, image, reference_depth, weight, scales = a
        none = depth.new_zeros(len(scales))
        points, quats = none[:, None].expand(-1, 3), none[:, None].expand(-1, 4)
        gaussians = GaussianMap(points, quats, scales.log(), none, points, none.long())
        rendering = Rendering(color, depth, torch.zeros_like(depth), none, none)
        view = image, reference_depth, weight
        loss = render_loss(gaussians, rendering, *view, METRIC_MEDIAN, config)
        return shares[0] * loss.color + shares[1] * loss.depth + shares[2] * loss.isotropic

    def of_known(*a: Tensor) -> Tensor:
        known = (a[3] > 0).double().mean()
        return reference(*a, shares=(0.8, 0.2 / float(known), 10))

    def with_unknown(*a: Tensor) -> Tensor:
        return reference(*a) + 0.2 * (a[4] * (a[3] == 0) * a[1]).mean()

    source = torch.Generator().manual_seed(1)
    color, image = random(source, 5, 6, 3), 0.1 + 0.9 * random(source, 5, 6, 3)
    depth, full, weight = 1 + random(source, 5, 6), 1 + random(source, 5, 6), random(source, 5, 6)
    holes = torch.where(random(source, 5, 6) < 0.3, 0, full)
    needles, one = 0.1 * random(source, 4, 3), torch.ones_like(depth)
    scales = needles[:, :1].expand(4, 3)
    cases = [
        Case((color, depth, image, full, one, scales), "round Gaussians and equal weights"),
        Case((color, depth, image, full, weight, scales), "weights that differ"),
        Case((color, depth, image, holes, weight, scales), "depth that is unknown in places"),
        Case((color, depth, image, holes, weight, needles), "thin Gaussians"),
    ]
    hints = [
        (lambda *a: reference(*a[:4], one, a[5]), "Each pixel has its weight."),
        (lambda *a: reference(*a[:4], a[4] / a[4].mean(), a[5]), "Divide by the number of pixels."),
        (lambda *a: reference(*a, shares=(0.8, 0.2, 0)), "L_iso is missing."),
        (lambda *a: reference(*a, shares=(0.8, 0.2, 1)), "L_iso is multiplied by 10."),
        (lambda *a: reference(*a, shares=(0.2, 0.8, 10)), "0.8 is for colour, 0.2 for depth."),
        (of_known, "The mean is over all pixels; one of unknown depth counts 0."),
        (with_unknown, "Where the reference depth is 0 it is unknown and costs nothing."),
    ]
    return check_function(student, reference, cases, 1e-7, hints)


def check_followed_pose(student: Callable[..., Tensor]) -> Verdict:
    """Check (map, camera, T_camera_world, image, weight, steps) -> the pose that took the image.

    The image is rendered from the true pose, so that the answer is known, whatever the method.
    What is compared is where the pose sees the centres of the Gaussians [px].
    """
    camera, count = Camera(24.0, 24.0, 15.5, 11.5, 32, 24), 60
    source = torch.Generator().manual_seed(3)
    z = 1 + 3 * random(source, count, 1)
    pixels = random(source, count, 2) * doubles(40, 32) - 4
    means = camera.backproject(pixels, z[:, 0])
    rows = torch.tensor([1.0, 0, 0, 0]).expand(count, 4), (0.165 * z).log().expand(-1, 3).float()
    looks = torch.full((count,), 2.0), random(source, count, 3).float()

    def case(turn: float, start: Tensor, mover: bool, description: str) -> tuple[Case, Tensor]:
        true, weight = se3_exp(doubles(0.1, 0, 0.1, 0, turn, 0)), torch.ones(24, 32)
        world = transform_points(se3_inverse(true), means).float()
        gaussians = GaussianMap(world, *rows, *looks, torch.zeros(count, dtype=torch.int64))
        image = render(gaussians, camera, true.float()).color
        if mover:  # the left half of the image moves to the right
            image[:, 3:17], weight[:, :17] = image[:, :14].clone(), 0
        inputs = gaussians, camera, se3_exp(start) @ true, image, weight, 15
        return Case(inputs, description), true

    pairs = [
        case(0.2, doubles(0.04, -0.03, 0.03, 0, 0, 0), False, "a camera that has moved"),
        case(0.8, doubles(0.04, 0, 0, 0, 0, 0.03), False, "a camera that has turned"),
        case(0.2, doubles(-0.03, 0.03, 0, 0, 0, 0), True, "an object that moves in the image"),
    ]

    def true_pose(*a: Any) -> Tensor:
        return next(pose for case, pose in pairs if case.arguments[2] is a[2])

    def seen_from(follow: Callable[..., Any]) -> Callable[..., Tensor | None]:
        @wraps(follow)
        def pixels_of(*a: Any) -> Tensor | None:
            pose = follow(*a)
            if pose is None or torch.as_tensor(pose).shape != (4, 4):
                return pose
            return camera.project(
                transform_points(torch.as_tensor(pose).double(), a[0].means.double())
            )

        return pixels_of

    def motion(*a: Any) -> Tensor:
        return true_pose(*a) @ se3_inverse(a[2])

    def unweighted(*a: Any) -> Tensor:
        gaussians, camera, pose, image, weight, _ = a
        equal, black = torch.ones_like(weight), torch.zeros(3)
        return refine_pose(gaussians, camera, pose, image, equal, black, settings)

    settings = PoseRefinementConfig(iterations=30, tolerance=0.0, farthest=1e9, fraction=1.0)
    mistakes = [
        (lambda *a: a[2], "The pose has not moved: return exp(twist) times the first pose."),
        (lambda *a: se3_inverse(true_pose(*a)), "This is T_world_camera."),
        (motion, "This is the motion alone."),
        (lambda *a: a[2] @ motion(*a), "The twist is applied on the left: exp(twist) @ T."),
        (lambda *a: se3_inverse(motion(*a)) @ a[2], "The pose moves the other way."),
        (unweighted, "The camera follows the dynamic object: each pixel has its weight."),
    ]
    hints = [(seen_from(mistake), hint) for mistake, hint in mistakes]
    cases = [case for case, _ in pairs]
    return check_function(seen_from(student), seen_from(true_pose), cases, 0.016, hints)
