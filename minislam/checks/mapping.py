"""Exercises of notebook 07."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import Case, Function, Hints, Verdict, check_function, normals
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

    def exchanged(count: int, window: list[int], weight: float) -> Tensor:
        return sampling_probabilities(count, [k for k in range(count) if k not in window], weight)

    def undivided(count: int, window: list[int], weight: float) -> Tensor:
        probabilities = torch.full((count,), 1 - weight, dtype=torch.float64)
        probabilities[window] = weight
        return probabilities

    def newest(count: int, window: list[int], weight: float) -> Tensor:
        return sampling_probabilities(count, list(range(count))[-len(window) :], weight)

    def guarded_at_half(count: int, window: list[int], weight: float) -> Tensor:
        return (uniform if len(window) > 0.5 * count else unguarded)(count, window, weight)

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
    ]
    hints: Hints = [
        (unguarded, "While the window is most of the map, all keyframes are equally likely."),
        (uniform, "The window should get its weight, however many other keyframes there are."),
        (window_only, "The other keyframes are left out: the map would forget them."),
        (undivided, "The window shares its weight: divide by the number of keyframes in it."),
        (exchanged, "The weight belongs to the window, 1 - weight to the others."),
        (lambda n, w, s: unguarded(n, w, 1 - s), "The weight belongs to the window."),
        (lambda n, w, s: sampling_probabilities(n, w, 0.5), "One half is one weight of many."),
        (newest, "The window lists positions: they need not be the newest ones."),
        (guarded_at_half, "Compare the window's share of all keyframes with the weight."),
    ]
    return check_function(student, sampling_probabilities, cases, 1e-6, hints, draw)


def check_deformed_means(
    student: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
) -> Verdict:
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

    def only(part: slice) -> Function:
        def changed(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
            motion = torch.eye(4, dtype=old.dtype).repeat(len(old), 1, 1)
            motion[:, :3, part] = (se3_inverse(new) @ old)[:, :3, part]
            return moved(motion, means, rows)

        return changed

    def draw(seed: int) -> Case:
        rows = normals(seed, 6).argsort() % 3
        poses = se3_exp(0.3 * normals(seed, 2, 3, 6))
        return Case((normals(seed, 6, 3), rows, *poses), f"the keyframes {rows.tolist()}")

    everything = torch.zeros(5, dtype=torch.int64)
    cases = [
        Case((means, everything, old, new), "a map of one keyframe"),
        Case((means, torch.tensor([0, 1, 1, 0, 1]), old, new), "two keyframes that move apart"),
    ]
    hints: Hints = [
        (lambda x, r, a, b: moved(se3_inverse(a) @ b, x, r), "The old pose comes first."),
        (lambda x, r, a, b: moved(b @ se3_inverse(a), x, r), "This moves points of a camera."),
        (lambda x, r, a, b: reference(x, 0 * r, a, b), "All follow the first keyframe."),
        (lambda x, r, a, b: x, "The means have not moved."),
        (lambda x, r, a, b: moved(a, x, r), "In the camera now: the new pose takes them back."),
        (only(slice(0, 3)), "The translation is missing."),
        (only(slice(3, 4)), "The rotation is missing."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)
