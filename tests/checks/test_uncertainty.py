"""The checks of notebook 04: right answers pass, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import WRONG, check_best_beta, check_feature_variance
from tests.helpers import assert_graded


def best_beta(error: Tensor, lambda_log: float) -> Tensor:
    return (2 / lambda_log) ** 0.5 * error.sqrt()


def feature_variance(beta: Tensor, features: Tensor) -> Tensor:
    cosines = torch.cosine_similarity(features[:, None], features[None], dim=-1)
    groups = [beta[row > 0.75] for row in cosines]
    return torch.stack([group.var(correction=0) for group in groups]).mean()


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_best_beta, best_beta)
    assert_graded(check_feature_variance, feature_variance)


def test_known_mistakes_of_uncertainty_are_named():
    assert "factor 2" in check_best_beta(lambda error, x: (error / x).sqrt()).sentence
    assert "take the root" in check_best_beta(lambda error, x: 2 * error / x).sentence
    assert "lambda_3 is not" in check_best_beta(lambda error, x: error.sqrt()).sentence
    assert "only similar" in check_feature_variance(lambda b, f: b.var(correction=0)).sentence

    def by_dot_product(beta: Tensor, features: Tensor) -> Tensor:
        groups = [beta[row > 0.75] for row in features @ features.T]
        return torch.stack([group.var(correction=0) for group in groups if len(group)]).mean()

    verdict = check_feature_variance(by_dot_product)
    assert verdict.status == WRONG and "for five cells" in verdict.sentence
