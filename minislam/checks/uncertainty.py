"""Exercises of notebook 04."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks.grading import Case, Verdict, check_function, doubles, drawn, normals
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.losses import variance_regulariser
from minislam.uncertainty.mlp import UncertaintyMLP
from minislam.uncertainty.training import RenderingError, uncertainty_loss


def check_best_beta(student: Callable[[Tensor, float], Tensor]) -> Verdict:
    """Check (L (n,), lambda_3) -> argmin of L / beta^2 + lambda_3 log beta over beta, (n,)."""

    def reference(error: Tensor, lambda_log: float) -> Tensor:
        return (2 * error / lambda_log).sqrt()

    def draw(seed: int) -> Case:
        lambda_log = round(0.2 + abs(normals(seed, 1).item()), 2)
        return Case((normals(seed, 4).square(), lambda_log), f"lambda_3 = {lambda_log}")

    error = doubles(0.0, 0.01, 0.5, 2.0, 6.0)
    cases = [
        Case((error, 2.0), "lambda_3 = 2"),
        Case((error, 0.5), "lambda_3 = 0.5"),
        *drawn(draw),
    ]
    hints = [
        (lambda L, _: L.sqrt(), "lambda_3 is not in it: set the derivative to zero and solve."),
        (lambda L, x: (L / x).sqrt(), "A factor 2 is missing: d(L beta^-2) = -2 L beta^-3."),
        (lambda L, x: 2 * L / x, "This is beta squared: take the root."),
        (lambda L, x: (L * x / 2).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: (2 * L * x).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: reference(L, x).clamp_min(0.1), "No floor is asked for: 0 stays 0."),
    ]
    return check_function(student, reference, cases, 1e-9, hints)


def check_feature_variance(student: Callable[[Tensor, Tensor], Tensor]) -> Verdict:
    """Check (beta (n,), features (n, C)) -> L_reg_V () with the neighbours of cosine > 0.75."""
    config = UncertaintyConfig()

    def reference(beta: Tensor, features: Tensor) -> Tensor:
        return variance_regulariser(beta, features, config)

    def masked(beta: Tensor, near: Tensor, lost: int = 0) -> Tensor:
        mean, count = near @ beta / near.sum(1), near.sum(1)
        squares = (beta[None] - mean[:, None]) ** 2
        return (near * squares).sum(1) / (count - lost).clamp_min(lost)

    def similar(features: Tensor) -> Tensor:
        unit = functional.normalize(features, dim=-1)
        return (unit @ unit.T > config.similarity).to(features)

    def not_normalised(beta: Tensor, features: Tensor) -> Tensor:
        return masked(beta, (features @ features.T > config.similarity).to(beta)).mean()

    def without_itself(beta: Tensor, features: Tensor) -> Tensor:
        return masked(beta, similar(features).fill_diagonal_(0)).nan_to_num().mean()

    def around_all(beta: Tensor, features: Tensor) -> Tensor:
        near = similar(features)
        return (near @ (beta - beta.mean()) ** 2 / near.sum(1)).mean()

    beta = doubles(0.2, 1.4, 0.5, 2.0, 0.9)
    features = doubles([3.0, 0.0], [2.0, 1.0], [0.0, 0.5], [0.1, 0.5], [1.0, -1.0])
    cases = [
        Case((beta[:2], torch.eye(2, dtype=torch.float64)), "two cells that are not similar"),
        Case((beta, features), "five cells in three groups"),
        *drawn(lambda seed: Case((normals(seed, 7).abs(), normals(seed, 7, 2)), "seven cells")),
    ]
    hints = [
        (lambda b, f: masked(b, f.new_ones(len(b), len(b))).mean(), "Compare only similar cells."),
        (not_normalised, "Divide each feature by its length: the cosine has no unit."),
        (lambda b, f: masked(b, similar(f)).sqrt().mean(), "The variance is the square of this."),
        (without_itself, "A cell is one of its own neighbours."),
        (lambda b, f: masked(b, similar(f), 1).mean(), "Divide by the number, not by one less."),
        (around_all, "The mean is that of the similar cells, not that of all."),
        (lambda b, f: masked(b, similar(f)).sum(), "The mean over the cells is asked for."),
    ]
    return check_function(student, reference, cases, 1e-9, hints)


def check_training(student: Callable[..., Tensor]) -> Verdict:
    """Check (mlp, optimizer, features, ssim, depth, opacity, steps) -> losses (steps,), Eq. (4).

    The answer is compared together with what the MLP then predicts.
    """
    features, (ssim, depth) = 2 * normals(0, 2, 3, 4, 5), 2 * normals(1, 2, 2, 3, 4).abs()
    opacity = torch.where(normals(2, 2, 3, 4) > -0.5, 0.95, 0.5).double()

    def trained(*views: Any, flaw: str = "") -> Tensor:
        off: dict[str, Any] = {flaw: 0.0} if "lambda" in flaw else {}
        config = replace(UncertaintyConfig(), **off)
        mlp, optimizer, features, ssim, depth, opacity, steps = views
        losses = []
        for step in range(steps):
            t = 0 if flaw == "first" else step % len(features)
            beta, sample = mlp(features[t]), features[t].flatten(0, 1)
            error = RenderingError(ssim[t], depth[t], opacity[t] + (flaw == "holes"))
            losses.append(uncertainty_loss(beta, error, beta.flatten(), sample, config))
            if flaw != "gathered":
                optimizer.zero_grad()
            losses[-1].backward()
            if flaw != "still":
                optimizer.step()
        return torch.stack(losses).detach()

    def with_mlp(train: Callable) -> Callable:
        def outcome(features: Tensor, *rest: Any, flaw: str = "") -> Tensor | None:
            mlp = UncertaintyMLP(5, torch.Generator().manual_seed(1)).to(features)
            # Plain descent: Adam would hide a loss that is twice too large.
            descent = torch.optim.SGD(mlp.parameters(), lr=0.02)
            asked = {"flaw": flaw} if flaw else {}
            losses = train(mlp, descent, features, *rest, **asked)
            if losses is None:
                return None
            return torch.cat([torch.as_tensor(losses), mlp(features).flatten()]).detach()

        return outcome

    def draw(seed: int) -> Case:
        return Case((normals(seed, 2, 3, 4, 5), ssim, depth, opacity, 3), f"features {seed}")

    cases = [
        Case((features, ssim, depth, torch.ones_like(opacity), 1), "one step"),
        Case((features, ssim, depth, opacity, 1), "one step, with holes in the map"),
        Case((features, ssim, depth, opacity, 4), "four steps on two views"),
        *drawn(draw),
    ]
    flaws = {
        "lambda_depth": "L_depth is missing in the error.",
        "lambda_variance": "L_reg_V is missing.",
        "lambda_log": "The price of a large beta is missing: 0.5 log beta.",
        "holes": "A cell of opacity below 0.9 has no loss.",
        "first": "The views take turns: step s looks at view s modulo T.",
        "gathered": "Gradients add up: call zero_grad before backward.",
        "still": "The MLP did not change: call optimizer.step().",
    }
    return check_function(with_mlp(student), with_mlp(trained), cases, 1e-6, flaws=flaws)
