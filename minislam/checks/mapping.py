"""Exercises of notebook 07."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function, drawn, normals
from minislam.geometry import se3_exp, se3_inverse, transform_points
from minislam.mapping.deformation import deform_rigidly
from minislam.mapping.window import sampling_probabilities
from minislam.splatting import GaussianMap


def check_sampling(student: Callable[[int, list[int], float], Tensor]) -> Verdict:
    """Check (number of keyframes N, window, weight) -> the probability of each keyframe (N,)."""

    right = sampling_probabilities

    def shared(count: int, window: list[int], inside: float, outside: float) -> Tensor:
        probabilities = torch.full((count,), outside, dtype=torch.float64)
        probabilities[window] = inside
        return probabilities

    def uniform(count: int, *rest: Any) -> Tensor:
        return torch.full((count,), 1 / count, dtype=torch.float64)

    def unguarded(n: int, window: list[int], weight: float) -> Tensor:
        return shared(n, window, weight / len(window), (1 - weight) / max(n - len(window), 1))

    def guarded_at_half(n: int, window: list[int], weight: float) -> Tensor:
        return (uniform if len(window) > 0.5 * n else unguarded)(n, window, weight)

    def draw(seed: int) -> Case:
        count, weight = 20 + seed % 7, (0.3, 0.6, 0.8)[seed % 3]
        window = normals(seed, count).argsort()[: 4 + seed % 2].tolist()
        return Case((count, window, weight), f"the window {window} of {count}, weight {weight}")

    cases = [
        Case((30, list(range(29, 19, -1)), 0.5), "30 keyframes, 10 of them in the window"),
        Case((13, list(range(12, 2, -1)), 0.5), "13 keyframes, 10 of them in the window"),
        Case((4, [3, 2, 1, 0], 0.5), "a window that holds all keyframes"),
        Case((20, [19, 18, 17, 5, 2], 0.3), "the weight 0.3"),
        Case((20, [19, 18, 17, 16, 15, 14, 13, 12, 11, 10, 3, 2], 0.7), "the weight 0.7"),
        *drawn(draw),
    ]
    hints = [
        (unguarded, "While the window is most of the map, all keyframes are equally likely."),
        (uniform, "The window should get its weight, however many other keyframes there are."),
        (lambda n, w, s: shared(n, w, 1 / len(w), 0), "The others: the map would forget them."),
        (lambda n, w, s: shared(n, w, s, 1 - s), "The keyframes of the window share its weight."),
        (lambda n, w, s: right(n, [*{*range(n)} - {*w}], s), "The weight is that of the window."),
        (lambda n, w, s: unguarded(n, w, 1 - s), "The weight belongs to the window."),
        (lambda n, w, s: right(n, w, 0.5), "One half is one weight of many."),
        (lambda n, w, s: right(n, [*range(n)][-len(w) :], s), "Not the newest, but the window."),
        (guarded_at_half, "Compare the window's share of all keyframes with the weight."),
    ]
    return check_function(student, right, cases, 1e-6, hints)


def check_deformed_means(student: Callable[..., Tensor]) -> Verdict:
    """Check (means (N, 3), anchor_rows (N,), T_old, T_new (K, 4, 4)) -> moved means (N, 3).

    The poses are T_camera_world; each mean follows the keyframe of its row.
    """
    means = normals(0, 5, 3)
    old, new = se3_exp(0.3 * normals(1, 2, 2, 6))

    def reference(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
        zeros = torch.zeros_like(means)
        quats = means.new_tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
        gaussians = GaussianMap(means, quats, zeros, zeros[:, 0], zeros, rows)
        return deform_rigidly(gaussians, rows, old, new).means

    def moved(motion: Tensor, means: Tensor, rows: Tensor) -> Tensor:
        return transform_points(motion[rows], means[:, None])[:, 0]

    def only(part: slice, means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
        motion = torch.eye(4, dtype=old.dtype).repeat(len(old), 1, 1)
        motion[:, :3, part] = (se3_inverse(new) @ old)[:, :3, part]
        return moved(motion, means, rows)

    def draw(seed: int) -> Case:
        rows = normals(seed, 6).argsort() % 3
        poses = se3_exp(0.3 * normals(seed, 2, 3, 6))
        return Case((normals(seed, 6, 3), rows, *poses), f"the keyframes {rows.tolist()}")

    everything = torch.zeros(5, dtype=torch.int64)
    cases = [
        Case((means, everything, old, new), "a map of one keyframe"),
        Case((means, torch.tensor([0, 1, 1, 0, 1]), old, new), "two keyframes that move apart"),
        *drawn(draw),
    ]
    hints = [
        (lambda x, r, a, b: moved(se3_inverse(a) @ b, x, r), "The old pose comes first."),
        (lambda x, r, a, b: moved(b @ se3_inverse(a), x, r), "This moves points of a camera."),
        (lambda x, r, a, b: reference(x, 0 * r, a, b), "All follow the first keyframe."),
        (lambda x, r, a, b: x, "The means have not moved."),
        (lambda x, r, a, b: moved(a, x, r), "In the camera now: the new pose takes them back."),
        (lambda *a: only(slice(0, 3), *a), "The translation is missing."),
        (lambda *a: only(slice(3, 4), *a), "The rotation is missing."),
    ]
    return check_function(student, reference, cases, 1e-9, hints)
