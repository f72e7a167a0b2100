"""The checks of notebook 06: right answers pass, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import check_flow_distance, check_suppressed
from minislam.geometry import Camera, se3_inverse, transform_points
from tests.helpers import assert_graded


def distance(
    poses: Tensor, disparities: Tensor, rays: Tensor, pixels: Tensor, camera: Camera, beta: float
) -> Tensor:
    lengths = []
    for source, target in ((0, 1), (1, 0)):
        motion = poses[target] @ se3_inverse(poses[source])
        slide = torch.eye(4, dtype=poses.dtype)
        slide[:3, 3] = motion[:3, 3]
        for transform, part in ((motion, beta), (slide, 1 - beta)):
            points = transform_points(transform, rays / disparities[source][:, None])
            lengths.append(part * (camera.project(points) - pixels).norm(dim=1).mean())
    return sum(lengths) / 2


def suppressed(newer: int, older: int, count: int, suppression: int) -> Tensor:
    radius = max(min(newer - older - 2, suppression), 0)
    passed = [
        [a > b and abs(a - newer) + abs(b - older) <= radius for b in range(count)]
        for a in range(count)
    ]
    return torch.tensor(passed)


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_flow_distance, distance)
    assert_graded(check_suppressed, suppressed)


def test_known_mistakes_of_tracking_are_named():
    assert (
        "has the weight 1 - eta" in check_flow_distance(lambda *a: distance(*a[:-1], 1.0)).sentence
    )
    verdict = check_flow_distance(lambda *a: distance(*a[:-1], 0.0))
    assert "for a camera that turns" in verdict.sentence and "alone" in verdict.sentence
    assert "exchanged" in check_flow_distance(lambda *a: distance(*a[:-1], 0.25)).sentence

    def square(newer: int, older: int, count: int, suppression: int) -> Tensor:
        a, b = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
        radius = max(min(newer - older - 2, suppression), 0)
        return ((a - newer).abs() <= radius) & ((b - older).abs() <= radius) & (a > b)

    assert "diamond" in check_suppressed(square).sentence
    verdict = check_suppressed(lambda i, j, count, s: suppressed(20, 2, 40, 2) * 0 + 1)
    assert "the shape is" in verdict.sentence

    def unlimited(newer: int, older: int, count: int, suppression: int) -> Tensor:
        a, b = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
        return ((a - newer).abs() + (b - older).abs() <= suppression) & (a > b)

    assert "shrinks" in check_suppressed(unlimited).sentence
    verdict = check_suppressed(lambda *a: suppressed(*a) | suppressed(*a).T)
    assert "newer, older" in verdict.sentence
