"""Exercises of notebook 07."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function
from minislam.geometry import se3_exp, se3_inverse, transform_points
from minislam.mapping.deformation import deform_rigidly
from minislam.mapping.window import sampling_probabilities
from minislam.splatting import GaussianMap


def check_sampling(student: Callable[[int, list[int], float], Tensor]) -> Verdict:
    """Check (number of keyframes N, window, weight) -> the probability of each keyframe (N,)."""

    def unguarded(count: int, window: list[int], weight: float) -> Tensor:
        others = (1 - weight) / max(count - len(window), 1)
        probabilities = torch.full((count,), others, dtype=torch.float64)
        probabilities[window] = weight / len(window)
        return probabilities

    def uniform(count: int, window: list[int], weight: float) -> Tensor:
        return torch.full((count,), 1 / count, dtype=torch.float64)

    def window_only(count: int, window: list[int], weight: float) -> Tensor:
        probabilities = torch.zeros(count, dtype=torch.float64)
        probabilities[window] = 1 / len(window)
        return probabilities

    cases = [
        Case((30, list(range(29, 19, -1)), 0.5), "30 keyframes, 10 of them in the window"),
        Case((13, list(range(12, 2, -1)), 0.5), "13 keyframes, 10 of them in the window"),
        Case((4, [3, 2, 1, 0], 0.5), "a window that holds all keyframes"),
    ]
    hints = [
        (unguarded, "While the window is most of the map, all keyframes are equally likely."),
        (uniform, "The window should get its weight, however many other keyframes there are."),
        (window_only, "The other keyframes are left out: the map would forget them."),
    ]
    return check_function(student, sampling_probabilities, cases, hints=hints)


def check_deformed_means(
    student: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
) -> Verdict:
    """Check (means (N, 3), anchor_rows (N,), T_old, T_new (K, 4, 4)) -> moved means (N, 3).

    The poses are T_camera_world; each mean follows the keyframe of its row.
    """
    source = torch.Generator().manual_seed(0)
    means = torch.randn(5, 3, generator=source, dtype=torch.float64)
    old, new = (
        se3_exp(0.3 * torch.randn(2, 6, generator=source, dtype=torch.float64)) for _ in range(2)
    )

    def reference(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
        zeros = torch.zeros_like(means)
        quats = means.new_tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
        gaussians = GaussianMap(means, quats, zeros, zeros[:, 0], zeros, rows)
        return deform_rigidly(gaussians, rows, old, new).means

    def moved(motion: Tensor, means: Tensor, rows: Tensor) -> Tensor:
        return transform_points(motion[rows], means[:, None])[:, 0]

    everything = torch.zeros(5, dtype=torch.int64)
    cases = [
        Case((means, everything, old, new), "a map of one keyframe"),
        Case((means, torch.tensor([0, 1, 1, 0, 1]), old, new), "two keyframes that move apart"),
    ]
    hints = [
        (lambda x, r, a, b: moved(se3_inverse(a) @ b, x, r), "The old pose comes first."),
        (
            lambda x, r, a, b: moved(b @ se3_inverse(a), x, r),
            "This moves points of a camera frame.",
        ),
        (lambda x, r, a, b: reference(x, 0 * r, a, b), "All follow the first keyframe."),
    ]
    return check_function(student, reference, cases, tolerance=1e-9, hints=hints)
