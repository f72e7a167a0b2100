"""The graders of notebooks 06 and 08: right answers pass, known mistakes are named."""

import numpy as np
import pytest
import torch
from torch import Tensor

from minislam.checks import (
    check_ate,
    check_flow_distance,
    check_separability,
    check_suppressed,
)
from minislam.geometry import Camera, se3_inverse, transform_points
from tests.helpers import assert_graded


def distance(
    poses: Tensor, disparities: Tensor, rays: Tensor, pixels: Tensor, camera: Camera, share: float
) -> Tensor:
    lengths = []
    for source, target in ((0, 1), (1, 0)):
        motion = poses[target] @ se3_inverse(poses[source])
        slide = torch.eye(4, dtype=poses.dtype)
        slide[:3, 3] = motion[:3, 3]
        for transform, part in ((motion, share), (slide, 1 - share)):
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


def procrustes(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimate turned and centred like the truth, not yet scaled, and the truth."""
    estimate, truth = estimate - estimate.mean(0), truth - truth.mean(0)
    u, _, v = np.linalg.svd(truth.T @ estimate)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return estimate @ turn.T, truth


def ate(estimate: np.ndarray, truth: np.ndarray) -> float:
    estimate, truth = procrustes(estimate, truth)
    scale = (estimate * truth).sum() / (estimate**2).sum()
    return float(np.sqrt(((scale * estimate - truth) ** 2).sum(1).mean()))


def separability(beta: np.ndarray, moving: np.ndarray) -> float:
    won = [float(a > b) + 0.5 * float(a == b) for a in beta[moving] for b in beta[~moving]]
    return float(np.mean(won))


CHECKS = [
    (check_flow_distance, distance),
    (check_suppressed, suppressed),
    (check_ate, ate),
    (check_separability, separability),
]


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_solution_passes_and_one_percent_is_wrong(check, solution):
    assert_graded(check, solution)


def test_known_mistakes_of_tracking_are_named():
    assert "without rotation." in check_flow_distance(lambda *a: distance(*a[:-1], 1.0)).sentence
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


def test_known_mistakes_of_evaluation_are_named():
    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt((difference**2).sum(1).mean()))

    unscaled = check_ate(lambda e, t: rms(np.subtract(*procrustes(e, t))))
    assert "no scale" in unscaled.sentence
    assert "not aligned" in check_ate(lambda e, t: rms(e - t)).sentence
    assert "mapped to the estimate" in check_ate(lambda e, t: ate(t, e)).sentence
    assert "one half" in check_separability(
        lambda b, m: float((b[m][:, None] > b[~m]).mean())
    ).sentence  # fmt: skip
    assert "other way round" in check_separability(lambda b, m: separability(b, ~m)).sentence
