"""Exercises of notebook 06."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import (
    CAMERA,
    Case,
    Function,
    Hints,
    Verdict,
    check_function,
    doubles,
    normals,
)
from minislam.geometry import Camera, se3_exp
from minislam.tracking.frame_graph import flow_distances, proximity_pairs
from minislam.tracking.reprojection import relative_transforms, reproject


def check_flow_distance(
    student: Callable[[Tensor, Tensor, Tensor, Tensor, Camera, float], Tensor],
) -> Verdict:
    """Check (poses (2, 4, 4), disparities (2, N), rays, pixels, camera, beta) -> distance [px]."""
    pixels = CAMERA.pixel_grid(10, torch.float64).flatten(0, 1)
    disparities = 0.2 + 0.3 * normals(0, 2, len(pixels)).sigmoid()

    def reference(*arguments: Any) -> Tensor:
        return flow_distances(*arguments)[0, 1]

    def with_beta(change: Callable[[float], float]) -> Function:
        return lambda *arguments: reference(*arguments[:-1], change(arguments[-1]))

    def changed(length: Function, without_translation: bool = False) -> Function:
        """Return the distance with another mean of the flows (2, 2, N), both directions."""

        def distance(poses: Tensor, d: Tensor, rays: Tensor, pixels: Tensor, *rest: Any) -> Tensor:
            camera, beta = rest
            whole = relative_transforms(poses, [0, 1], [1, 0])
            part = torch.eye(4, dtype=poses.dtype).repeat(2, 1, 1)
            part[:, :3, 3] = whole[:, :3, 3]
            if without_translation:
                part = whole * (1 - part) + torch.eye(4, dtype=poses.dtype) * part
            flows = [reproject(T, d, rays, camera)[0] - pixels.T for T in (whole, part)]
            return beta * length(flows[0]) + (1 - beta) * length(flows[1])

        return distance

    def case(twist: list[float], beta: float, description: str) -> Case:
        poses = se3_exp(doubles([0.0] * 6, twist))
        rays = CAMERA.rays(pixels)
        return Case((poses, disparities, rays, pixels, CAMERA, beta), description)

    def draw(seed: int) -> Case:
        slide, turn = (0.1 * normals(seed, 2, 3).clamp(-2, 2)).tolist()
        return case([*slide, *[0.3 * angle for angle in turn]], 0.3, "another motion, beta = 0.3")

    cases = [
        case([0.3, -0.1, 0.0, 0.0, 0.0, 0.0], 0.75, "a camera that slides"),
        case([0.0, 0.0, 0.0, 0.02, 0.1, 0.0], 0.75, "a camera that turns"),
        case([0.3, 0.1, 0.2, 0.02, -0.05, 0.03], 0.75, "a camera that does both"),
    ]
    hints: Hints = [
        (with_beta(lambda beta: 1.0), "The flow without rotation has the weight 1 - beta."),
        (with_beta(lambda beta: 0.0), "This is the flow without rotation alone."),
        (with_beta(lambda beta: 1 - beta), "beta and 1 - beta are exchanged."),
        (with_beta(lambda beta: 0.75), "0.75 is one beta of many: use the argument."),
        (changed(lambda f: f[0].norm(dim=0).mean()), "One direction only: from 1 to 0 as well."),
        (changed(lambda f: f[1].norm(dim=0).mean()), "One direction only: from 0 to 1 as well."),
        (changed(lambda f: f.norm(dim=1).sum()), "Take the mean over the pixels, not the sum."),
        (changed(lambda f: f.mean(-1).norm(dim=1).mean()), "First the lengths, then their mean."),
        (changed(lambda f: f.norm(dim=1).median()), "The mean is asked for, not the median."),
        (changed(lambda f: f.abs().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (changed(lambda f: f.square().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (
            changed(lambda f: f.norm(dim=1).mean(), True),
            "Leave out the rotation, not the translation.",
        ),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_suppressed(student: Callable[[int, int, int, int], Tensor]) -> Verdict:
    """Check (newer, older, K, suppression) -> (K, K), 1 where a pair a > b is suppressed."""

    def reference(newer: int, older: int, count: int, suppression: int) -> Tensor:
        suppressed = torch.zeros(count, count)
        for a in range(count):
            for b in range(a):
                # All other pairs are too far apart, so only this one can be returned.
                distances = torch.full((count, count), 2.0)
                distances[a, b] = 0.0
                pairs = proximity_pairs(
                    distances, [(newer, older)], range(count), 1.0, count, suppression
                )
                suppressed[a, b] = not pairs
        return suppressed

    def within(radius: int, count: int, newer: int, older: int, order: float) -> Tensor:
        a, b = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
        offsets = torch.stack([a - newer, b - older]).double()
        return ((torch.linalg.vector_norm(offsets, order, 0) <= radius) & (a > b)).double()

    def radius_of(newer: int, older: int, suppression: int) -> int:
        return max(min(newer - older - 2, suppression), 0)

    def as_square(newer: int, older: int, count: int, suppression: int) -> Tensor:
        radius = radius_of(newer, older, suppression)
        return within(radius, count, newer, older, torch.inf)

    def unlimited(newer: int, older: int, count: int, suppression: int) -> Tensor:
        return within(suppression, count, newer, older, 1)

    def both_orders(newer: int, older: int, count: int, suppression: int) -> Tensor:
        answer = reference(newer, older, count, suppression)
        return answer + answer.T

    def of_radius(radius: Callable[[int, int], int]) -> Function:
        return lambda i, j, count, most: within(radius(i - j, most), count, i, j, 1)

    def draw(seed: int) -> Case:
        older, apart, most = 1 + seed % 4, 2 + seed % 5, 1 + seed % 3
        return Case((older + apart, older, 10, most), f"{apart} apart, suppression {most}")

    cases = [
        Case((8, 2, 11, 2), "a pair far apart in time"),
        Case((6, 3, 11, 2), "a pair three keyframes apart"),
        Case((5, 4, 11, 2), "two neighbours"),
    ]
    hints: Hints = [
        (as_square, "The neighbourhood is a diamond: |a| + |b|, not the larger of the two."),
        (unlimited, "Near the diagonal the radius shrinks: it is at most |i - j| - 2."),
        (both_orders, "Only pairs (newer, older) are wanted: a > b."),
        (of_radius(lambda n, most: min(n, most)), "At most |i - j| - 2: take 2 off."),
        (of_radius(lambda n, most: min(n - 2, most)), "A radius is at least 0: the pair itself."),
        (of_radius(lambda n, most: max(min(n - 2, most), 0) - 1), "Up to the radius: <=, not <."),
        (of_radius(lambda n, most: max(n - 2, 0)), "The radius is at most the suppression."),
        (of_radius(lambda n, most: 0), "Only the pair itself: its neighbours are left out, too."),
        (lambda *a: (1 - reference(*a)).tril(-1), "True stands for the pairs that are left out."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)
