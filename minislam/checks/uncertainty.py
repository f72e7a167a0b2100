"""Exercises of notebooks 00 and 04."""

from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn import functional

from minislam.checks.cases import Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera
from minislam.uncertainty import weights
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.losses import variance_regulariser
from minislam.uncertainty.mlp import UncertaintyMLP
from minislam.uncertainty.training import RenderingError, uncertainty_loss
from minislam.uncertainty.weights import MAPPING_CAP, MAPPING_CUT, mapping_weight, pixel_weight


def check_mapping_weight(student: Function) -> Verdict:
    """Check beta (h, w) -> the weight of each pixel in the map's loss (h, w)."""
    camera = Camera(5.0, 5.0, 1.0, 0.5, 3, 2)

    def uncapped(beta: Tensor) -> Tensor:
        return pixel_weight(beta, camera)

    def cut(weight: Tensor, most: float = MAPPING_CAP) -> Tensor:
        return torch.where(weight < MAPPING_CUT, 0.0, weight.clamp_max(most))

    cases = [
        Case((doubles([0.2, 0.471, 0.6], [0.7, 0.9, 1.2]),), "small beta"),
        Case((doubles([0.5, 1.3, 1.5], [2.0, 3.0, 4.0]),), "large beta"),
        Case((doubles([0.0, 0.05, 0.1], [0.5, 0.5, 0.5]),), "tiny beta"),
        *drawn(lambda seed: Case((1.2 * normals(seed, 2, 3).abs(),), "any beta")),
    ]
    mistakes = [
        (lambda b: uncapped(b).clamp_max(5), "Weights below 0.1 must be 0: little adds up."),
        (lambda b: cut(uncapped(b), 1e9), "No weight is above 5, that of a beta of 0.23."),
        (lambda b: uncapped(b).clamp(0.1, 5), "Weights below 0.1 become 0, not 0.1."),
        (lambda b: cut(uncapped(b.clamp_min(0.1) + 0.1)), "Take off 0.1 first."),
        (lambda beta: cut(0.5 / beta**2), "This is 0.5 / beta^2: beta is adjusted first."),
        (lambda beta: cut(2 * uncapped(beta)), "It is a half by beta_adj^2: 0.5 is missing."),
        (lambda beta: cut((0.5 * uncapped(beta)).sqrt()), "The adjusted beta must be squared."),
    ]
    return check_function(student, lambda b: mapping_weight(b, camera), cases, 1e-5, mistakes)


def check_best_beta(student: Function) -> Verdict:
    """Check (L (n,), lambda_3) -> argmin of L / beta^2 + lambda_3 log beta over beta, (n,)."""

    def reference(error: Tensor, lambda_log: float) -> Tensor:
        return (2 * error / lambda_log).sqrt()

    def case(lambda_log: float, seed: int = 0) -> Case:
        error = torch.cat([doubles(0.0), 2 * normals(seed, 4).square()])
        return Case((error, lambda_log), f"lambda_3 = {lambda_log}")

    cases = [case(3.0), case(0.5), *drawn(lambda seed: case(0.3 + 0.1 * (seed % 9), seed))]
    mistakes = [
        (lambda L, _: 2 * L.sqrt(), "2 sqrt(L) is for lambda_3 = 0.5 alone: use the argument."),
        (lambda L, _: L.sqrt(), "lambda_3 is not in it: set the derivative to zero and solve."),
        (lambda L, x: (L / x).sqrt(), "A factor 2 is missing: d(L beta^-2) = -2 L beta^-3."),
        (lambda L, x: 2 * L / x, "This is beta squared: take the root."),
        (lambda L, x: (L * x / 2).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: (2 * L * x).sqrt(), "lambda_3 belongs below the line: it makes beta small."),
        (lambda L, x: reference(L, x).clamp_min(0.1), "No floor is asked for: 0 stays 0."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_feature_variance(student: Function) -> Verdict:
    """Check (beta (n,), features (n, C)) -> L_reg_V () with the neighbours of cosine > 0.75."""
    config = UncertaintyConfig()

    def variance(beta: Tensor, features: Tensor, flaw: str = "") -> Tensor:
        if not flaw:
            return variance_regulariser(beta, features, config)
        unit = features if flaw == "long" else functional.normalize(features, dim=-1)
        near = (unit @ unit.T > (-2 if flaw == "all" else config.similarity)).to(beta)
        near = near.fill_diagonal_(0) if flaw == "others" else near
        count = near.sum(1, keepdim=True)
        means = near @ beta[:, None] / count
        variances = (near * (beta - means) ** 2 / (count - int(flaw == "one less"))).sum(1)
        variances = variances.nan_to_num().sqrt() if flaw == "root" else variances.nan_to_num()
        return variances.sum() if flaw == "sum" else variances.mean()

    beta = doubles(0.2, 1.4, 0.5, 2.0, 0.9)
    features = doubles([3.0, 0.0], [2.0, 1.0], [0.0, 0.5], [0.1, 0.5], [2.0, 0.5])
    cases = [
        Case((beta[:2], torch.eye(2, dtype=torch.float64)), "two cells that are not similar"),
        Case((beta, features), "five cells in two groups"),
        *drawn(lambda seed: Case((normals(seed, 7).abs(), normals(seed, 7, 2)), "seven cells")),
    ]
    mistakes = [
        ("all", "Compare only similar cells."),
        ("long", "Divide each feature by its length: the cosine has no unit."),
        ("root", "The variance is the square of this."),
        ("others", "A cell is one of its own neighbours."),
        ("one less", "Divide by the number, not by one less."),
        ("sum", "The mean over the cells is asked for."),
    ]
    return check_function(student, variance, cases, 1e-9, mistakes)


def check_training(student: Function) -> Verdict:
    """Check (mlp, optimizer, features, ssim, depth, opacity, steps) -> losses (steps,), Eq. (4).

    The answer is compared together with what the MLP then predicts.
    """
    # Small, because some beta are near 0.1: the loss is divided by their square.
    errors = 0.02 * normals(1, 2, 2, 3, 4).abs()
    holes = torch.where(normals(2, 2, 3, 4) > -0.5, 0.95, 0.5).double()

    def trained(*views: Any, flaw: str = "") -> Tensor:
        off: dict[str, Any] = {flaw: 0.0} if "lambda" in flaw else {}
        config = replace(UncertaintyConfig(), **off)
        mlp, optimizer, features, ssim, depth, opacity, steps = views
        losses = []
        for step in range(steps):
            t = 0 if flaw == "first" else step % len(features)
            beta, sample = mlp(features[t]), features[t].flatten(0, 1)
            error = RenderingError(ssim[t], depth[t], opacity[t] + (flaw == "holes"))
            own = beta.clamp_min(0.1) if flaw == "clipped" else beta
            share = float((opacity[t] >= 0.9).double().mean()) if flaw == "kept" else 1.0
            shared = replace(config, lambda_variance=share * config.lambda_variance)
            losses.append(uncertainty_loss(beta, error, own.flatten(), sample, shared) / share)
            if flaw != "gathered":
                optimizer.zero_grad()
            losses[-1].backward()
            if flaw != "still":
                optimizer.step()
        return torch.stack(losses).detach()

    def outcome(train: Function, features: Tensor, *rest: Any) -> Any:
        mlp = UncertaintyMLP(5, torch.Generator().manual_seed(1)).to(features)
        with torch.no_grad():
            mlp.biases[-1].sub_(3)  # some beta_raw are below 0.1
        # Plain descent: Adam would hide a loss that is twice too large.
        descent = torch.optim.SGD(mlp.parameters(), lr=0.02)
        losses = train(mlp, descent, features, *rest)
        return None if losses is None else (losses, mlp(features).detach())

    def case(opacity: Tensor, steps: int, description: str, seed: int = 0) -> Case:
        return Case((2 * normals(seed, 2, 3, 4, 5), *errors, opacity, steps), description)

    cases = [
        case(torch.ones_like(holes), 1, "one step"),
        case(holes, 1, "one step, with holes in the map"),
        case(holes, 4, "four steps on two views"),
        *drawn(lambda seed: case(holes, 3, f"features {seed}", seed)),
    ]
    no_floor = patch.object(weights, "BETA_FLOOR", 0.0)(trained)
    mistakes = [
        ("lambda_depth", "L_depth is missing in the error."),
        ("lambda_variance", "L_reg_V is missing."),
        ("lambda_log", "The price of a large beta is missing: 0.5 log beta."),
        ("holes", "A cell of opacity below 0.9 has no loss."),
        ("kept", "The mean is over all cells: those of opacity below 0.9 count as 0."),
        ("first", "The views take turns: step s looks at view s modulo T."),
        ("gathered", "Gradients add up: call zero_grad before backward."),
        ("still", "The MLP did not change: call optimizer.step()."),
        (no_floor, "The floor of beta is missing: max(beta_raw, 0.1)."),
        ("clipped", "L_reg_V uses beta_raw, without the floor."),
    ]
    returns = "the losses", "what the MLP then predicts"
    return check_function(student, trained, cases, 1e-6, mistakes, returns, outcome)
