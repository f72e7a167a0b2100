"""Exercises of notebook 04."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks.grading import Case, Verdict, check_function, doubles
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.losses import variance_regulariser


def check_best_beta(student: Callable[[Tensor, float], Tensor]) -> Verdict:
    """Check (L (n,), lambda_3) -> argmin of L / beta^2 + lambda_3 log beta over beta, (n,)."""

    def reference(error: Tensor, lambda_log: float) -> Tensor:
        return (2 * error / lambda_log).sqrt()

    error = doubles(0.0, 0.01, 0.5, 2.0, 6.0)
    cases = [Case((error, 2.0), "lambda_3 = 2"), Case((error, 0.5), "lambda_3 = 0.5")]
    hints = [
        (lambda L, _: L.sqrt(), "lambda_3 is not in it: set the derivative to zero and solve."),
        (lambda L, x: (L / x).sqrt(), "A factor 2 is missing: d(L beta^-2) = -2 L beta^-3."),
        (lambda L, x: 2 * L / x, "This is beta squared: take the root."),
    ]
    return check_function(student, reference, cases, tolerance=1e-9, hints=hints)


def check_feature_variance(student: Callable[[Tensor, Tensor], Tensor]) -> Verdict:
    """Check (beta (n,), features (n, C)) -> L_reg_V () with the neighbours of cosine > 0.75."""
    config = UncertaintyConfig()

    def reference(beta: Tensor, features: Tensor) -> Tensor:
        return variance_regulariser(beta, features, config)

    def masked(similar: Tensor, beta: Tensor) -> Tensor:
        mean = similar @ beta / similar.sum(1)
        squares = (beta[None] - mean[:, None]) ** 2
        return (similar * squares).sum(1) / similar.sum(1)

    def all_cells(beta: Tensor, features: Tensor) -> Tensor:
        return masked(torch.ones(len(beta), len(beta), dtype=beta.dtype), beta).mean()

    def not_normalised(beta: Tensor, features: Tensor) -> Tensor:
        return masked((features @ features.T > config.similarity).to(beta), beta).mean()

    def deviation(beta: Tensor, features: Tensor) -> Tensor:
        unit = functional.normalize(features, dim=-1)
        return masked((unit @ unit.T > config.similarity).to(beta), beta).sqrt().mean()

    beta = doubles(0.2, 1.4, 0.5, 2.0, 0.9)
    features = doubles([3.0, 0.0], [2.0, 1.0], [0.0, 0.5], [0.1, 0.5], [1.0, -1.0])
    cases = [
        Case((beta[:2], torch.eye(2, dtype=torch.float64)), "two cells that are not similar"),
        Case((beta, features), "five cells in three groups"),
    ]
    hints = [
        (all_cells, "Every cell is compared with every other: only similar ones count."),
        (not_normalised, "Divide each feature by its length: the cosine has no unit."),
        (deviation, "This is the standard deviation; the variance is its square."),
    ]
    return check_function(student, reference, cases, tolerance=1e-9, hints=hints)
