"""Exercises of notebook 04."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks.grading import Case, Verdict, check_function, doubles, normals
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.losses import variance_regulariser


def check_best_beta(student: Callable[[Tensor, float], Tensor]) -> Verdict:
    """Check (L (n,), lambda_3) -> argmin of L / beta^2 + lambda_3 log beta over beta, (n,)."""

    def reference(error: Tensor, lambda_log: float) -> Tensor:
        return (2 * error / lambda_log).sqrt()

    def draw(seed: int) -> Case:
        lambda_log = round(0.2 + abs(normals(seed, 1).item()), 2)
        return Case((normals(seed, 4).square(), lambda_log), f"lambda_3 = {lambda_log}")

    error = doubles(0.0, 0.01, 0.5, 2.0, 6.0)
    cases = [Case((error, 2.0), "lambda_3 = 2"), Case((error, 0.5), "lambda_3 = 0.5")]
    hints = [
        (lambda L, _: L.sqrt(), "lambda_3 is not in it: set the derivative to zero and solve."),
        (lambda L, x: (L / x).sqrt(), "A factor 2 is missing: d(L beta^-2) = -2 L beta^-3."),
        (lambda L, x: 2 * L / x, "This is beta squared: take the root."),
        (lambda L, x: (L * x / 2).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: (2 * L * x).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: reference(L, x).clamp_min(0.1), "No floor is asked for: 0 stays 0."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


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
        return masked(similar(features), beta).sqrt().mean()

    def similar(features: Tensor) -> Tensor:
        unit = functional.normalize(features, dim=-1)
        return (unit @ unit.T > config.similarity).to(features)

    def without_itself(beta: Tensor, features: Tensor) -> Tensor:
        others = similar(features).fill_diagonal_(0)
        return masked(others, beta).nan_to_num().mean()

    def unbiased(beta: Tensor, features: Tensor) -> Tensor:
        count = similar(features).sum(1)
        variance = masked(similar(features), beta) * count / (count - 1).clamp_min(1)
        return variance.mean()

    def around_all(beta: Tensor, features: Tensor) -> Tensor:
        near = similar(features)
        return (near @ (beta - beta.mean()) ** 2 / near.sum(1)).mean()

    def draw(seed: int) -> Case:
        return Case((normals(seed, 7).abs(), normals(seed, 7, 2)), "seven cells")

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
        (without_itself, "A cell is one of its own neighbours."),
        (unbiased, "Divide by the number of neighbours, not by the number minus one."),
        (around_all, "The mean is that of the similar cells, not that of all."),
        (lambda b, f: masked(similar(f), b).sum(), "The mean over the cells is asked for."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)
