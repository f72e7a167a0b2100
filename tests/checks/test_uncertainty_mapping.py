"""The graders of notebooks 04 and 07: right answers pass, known mistakes are named."""

import pytest
import torch
from torch import Tensor

from minislam.checks import (
    WRONG,
    check_best_beta,
    check_deformed_means,
    check_feature_variance,
    check_sampling,
)
from tests.helpers import assert_graded


def best_beta(misfit: Tensor, lambda_log: float) -> Tensor:
    return (2 / lambda_log) ** 0.5 * misfit.sqrt()


def feature_variance(beta: Tensor, features: Tensor) -> Tensor:
    cosines = torch.cosine_similarity(features[:, None], features[None], dim=-1)
    groups = [beta[row > 0.75] for row in cosines]
    return torch.stack([group.var(correction=0) for group in groups]).mean()


def sampling(count: int, window: list[int], share: float) -> Tensor:
    if len(window) > share * count:
        return torch.ones(count) / count
    inside = torch.tensor([float(k in window) for k in range(count)], dtype=torch.float64)
    outside = 1 - inside
    return share * inside / inside.sum() + (1 - share) * outside / outside.sum()


def deformed_means(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
    moved = []
    for mean, row in zip(means, rows, strict=True):
        in_camera = old[row] @ torch.cat([mean, mean.new_ones(1)])
        moved.append(torch.linalg.solve(new[row], in_camera)[:3])
    return torch.stack(moved)


CHECKS = [
    (check_best_beta, best_beta),
    (check_feature_variance, feature_variance),
    (check_sampling, sampling),
    (check_deformed_means, deformed_means),
]


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_solution_passes_and_one_percent_is_wrong(check, solution):
    assert_graded(check, solution)


def test_known_mistakes_of_uncertainty_are_named():
    assert "factor 2" in check_best_beta(lambda misfit, x: (misfit / x).sqrt()).sentence
    assert "take the root" in check_best_beta(lambda misfit, x: 2 * misfit / x).sentence
    assert "lambda_3 is not" in check_best_beta(lambda misfit, x: misfit.sqrt()).sentence
    assert "only alike" in check_feature_variance(lambda b, f: b.var(correction=0)).sentence

    def by_dot_product(beta: Tensor, features: Tensor) -> Tensor:
        groups = [beta[row > 0.75] for row in features @ features.T]
        return torch.stack([group.var(correction=0) for group in groups if len(group)]).mean()

    verdict = check_feature_variance(by_dot_product)
    assert verdict.status == WRONG and "for five cells" in verdict.sentence


def test_known_mistakes_of_mapping_are_named():
    verdict = check_sampling(lambda n, w, s: torch.full((n,), 1 / n))
    assert "its share" in verdict.sentence
    only = check_sampling(lambda n, w, s: torch.tensor([(k in w) / len(w) for k in range(n)]))
    assert "forget them" in only.sentence

    def without_guard(count: int, window: list[int], share: float) -> Tensor:
        outside = max(count - len(window), 1)
        values = [
            share / len(window) if k in window else (1 - share) / outside for k in range(count)
        ]
        return torch.tensor(values, dtype=torch.float64)

    verdict = check_sampling(without_guard)
    assert "for 13 keyframes" in verdict.sentence and "equally likely" in verdict.sentence
    inverse = check_deformed_means(lambda x, r, a, b: deformed_means(x, r, b, a))
    assert inverse.status == WRONG
    first = check_deformed_means(lambda x, r, a, b: deformed_means(x, 0 * r, a, b))
    assert "for two keyframes" in first.sentence and "first keyframe" in first.sentence
