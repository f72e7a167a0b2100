"""The checks of notebook 07: right answers pass, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import WRONG, check_deformed_means, check_sampling
from tests.helpers import assert_graded


def sampling(count: int, window: list[int], weight: float) -> Tensor:
    if len(window) > weight * count:
        return torch.ones(count) / count
    inside = torch.tensor([float(k in window) for k in range(count)], dtype=torch.float64)
    outside = 1 - inside
    return weight * inside / inside.sum() + (1 - weight) * outside / outside.sum()


def deformed_means(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
    moved = []
    for mean, row in zip(means, rows, strict=True):
        in_camera = old[row] @ torch.cat([mean, mean.new_ones(1)])
        moved.append(torch.linalg.solve(new[row], in_camera)[:3])
    return torch.stack(moved)


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_sampling, sampling)
    assert_graded(check_deformed_means, deformed_means)


def test_known_mistakes_of_mapping_are_named():
    verdict = check_sampling(lambda n, w, s: torch.full((n,), 1 / n))
    assert "its probability" in verdict.sentence
    only = check_sampling(lambda n, w, s: torch.tensor([(k in w) / len(w) for k in range(n)]))
    assert "forget them" in only.sentence

    def without_guard(count: int, window: list[int], weight: float) -> Tensor:
        outside = max(count - len(window), 1)
        values = [
            weight / len(window) if k in window else (1 - weight) / outside for k in range(count)
        ]
        return torch.tensor(values, dtype=torch.float64)

    verdict = check_sampling(without_guard)
    assert "for 13 keyframes" in verdict.sentence and "equally likely" in verdict.sentence

    def guarded_at_half(count: int, window: list[int], weight: float) -> Tensor:
        is_small = 2 * len(window) <= count
        return without_guard(count, window, weight) if is_small else torch.ones(count) / count

    verdict = check_sampling(guarded_at_half)
    assert "Compare the window's part" in verdict.sentence
    verdict = check_sampling(lambda n, w, s: sampling(n, w, s) * (1 + (len(w) == n)))
    assert "for a window that holds all keyframes" in verdict.sentence
    inverse = check_deformed_means(lambda x, r, a, b: deformed_means(x, r, b, a))
    assert inverse.status == WRONG
    first = check_deformed_means(lambda x, r, a, b: deformed_means(x, 0 * r, a, b))
    assert "for two keyframes" in first.sentence and "first keyframe" in first.sentence
