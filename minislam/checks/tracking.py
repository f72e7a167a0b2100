"""Exercises of notebook 06."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import CAMERA, Case, Function, Verdict, check_function, doubles
from minislam.geometry import Camera, se3_exp
from minislam.tracking.frame_graph import flow_distances, proximity_pairs


def check_flow_distance(
    student: Callable[[Tensor, Tensor, Tensor, Tensor, Camera, float], Tensor],
) -> Verdict:
    """Check (poses (2, 4, 4), disparities (2, N), rays, pixels, camera, beta) -> distance [px]."""
    pixels = CAMERA.pixel_grid(10, torch.float64).flatten(0, 1)
    source = torch.Generator().manual_seed(0)
    disparities = 0.2 + 0.3 * torch.rand(2, len(pixels), generator=source, dtype=torch.float64)

    def reference(*arguments: Any) -> Tensor:
        return flow_distances(*arguments)[0, 1]

    def with_beta(change: Callable[[float], float]) -> Function:
        return lambda *arguments: reference(*arguments[:-1], change(arguments[-1]))

    def case(twist: list[float], description: str) -> Case:
        poses = se3_exp(doubles([0.0] * 6, twist))
        rays = CAMERA.rays(pixels)
        return Case((poses, disparities, rays, pixels, CAMERA, 0.75), description)

    cases = [
        case([0.3, -0.1, 0.0, 0.0, 0.0, 0.0], "a camera that slides"),
        case([0.0, 0.0, 0.0, 0.02, 0.1, 0.0], "a camera that turns"),
        case([0.3, 0.1, 0.2, 0.02, -0.05, 0.03], "a camera that does both"),
    ]
    hints = [
        (with_beta(lambda beta: 1.0), "The flow without rotation has the weight 1 - beta."),
        (with_beta(lambda beta: 0.0), "This is the flow without rotation alone."),
        (with_beta(lambda beta: 1 - beta), "beta and 1 - beta are exchanged."),
    ]
    return check_function(student, reference, cases, tolerance=1e-9, hints=hints)


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

    cases = [
        Case((8, 2, 11, 2), "a pair far apart in time"),
        Case((6, 3, 11, 2), "a pair three keyframes apart"),
        Case((5, 4, 11, 2), "two neighbours"),
    ]
    hints = [
        (as_square, "The neighbourhood is a diamond: |a| + |b|, not the larger of the two."),
        (unlimited, "Near the diagonal the radius shrinks: it is at most |i - j| - 2."),
        (both_orders, "Only pairs (newer, older) are wanted: a > b."),
    ]
    return check_function(student, reference, cases, hints=hints)
