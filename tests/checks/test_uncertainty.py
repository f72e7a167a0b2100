"""The checks of notebook 04: right answers pass, known mistakes are named."""

from functools import partial

import pytest
import torch
from torch import Tensor

from minislam.checks import WRONG, check_best_beta, check_feature_variance, check_training
from tests.helpers import assert_graded, assert_variants


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
    assert "2 sqrt(L) is for" in check_best_beta(lambda error, x: 2 * error.sqrt()).sentence
    assert "only similar" in check_feature_variance(lambda b, f: b.var(correction=0)).sentence

    def by_dot_product(beta: Tensor, features: Tensor) -> Tensor:
        groups = [beta[row > 0.75] for row in features @ features.T]
        return torch.stack([group.var(correction=0) for group in groups if len(group)]).mean()

    verdict = check_feature_variance(by_dot_product)
    assert verdict.status == WRONG and "for five cells" in verdict.sentence


def trained(mlp, optimizer, features, ssim, depth, opacity, steps, flaw: str = "") -> Tensor:
    losses = []
    for step in range(steps):
        t = 0 if flaw == "first" else step % len(features)
        beta_raw = mlp(features[t])
        beta = beta_raw.clamp_min(0.0 if flaw == "no floor" else 0.1) + 0.001
        error = ssim[t] + (0 if flaw == "no depth" else 0.2) * depth[t]
        loss = error / beta ** (1 if flaw == "power" else 2)
        loss = loss + (0 if flaw == "no log" else 0.5 * beta.log())
        loss = loss[opacity[t] >= 0.9] if flaw == "kept" else loss
        loss = loss if flaw in ("holes", "kept") else torch.where(opacity[t] >= 0.9, loss, 0)
        loss = loss.sum() if flaw == "sum" else loss.mean()
        if flaw != "no reg_V":
            own = beta_raw.clamp_min(0.1) if flaw == "clipped" else beta_raw
            loss = loss + feature_variance(own.flatten(), features[t].flatten(0, 1))
        if flaw != "gathered":
            optimizer.zero_grad()
        loss.backward()
        if flaw != "still":
            optimizer.step()
        losses.append(loss.detach())
    return torch.stack(losses)


def trained_cell_by_cell(mlp, optimizer, features, ssim, depth, opacity, steps) -> list[float]:
    losses = []
    for step in range(steps):
        t = step % len(features)
        total, betas = 0.0, mlp(features[t])
        for i, row in enumerate(betas):
            for j, beta in enumerate(row):
                if opacity[t, i, j] >= 0.9:
                    beta = torch.maximum(beta, torch.tensor(0.1)) + 0.001
                    total = total + (ssim[t, i, j] + 0.2 * depth[t, i, j]) / beta**2
                    total = total + 0.5 * torch.log(beta)
        rest = feature_variance(betas.flatten(), features[t].flatten(0, 1))
        loss = total / betas.numel() + rest
        mlp.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


@pytest.mark.ex04_3
def test_a_training_is_told_from_a_wrong_one():
    wrong = {
        "L_depth is missing": partial(trained, flaw="no depth"),
        "L_reg_V is missing": partial(trained, flaw="no reg_V"),
        "price of a large beta": partial(trained, flaw="no log"),
        "opacity below 0.9": partial(trained, flaw="holes"),
        "take turns": partial(trained, flaw="first"),
        "zero_grad": partial(trained, flaw="gathered"),
        "did not change": partial(trained, flaw="still"),
        "beta, not its square": partial(trained, flaw="power"),
        "a sum": partial(trained, flaw="sum"),
        "no floor": partial(trained, flaw="no floor"),
        "L_reg_V of the clipped beta": partial(trained, flaw="clipped"),
    }
    assert_variants(check_training, {"one": trained, "other": trained_cell_by_cell}, wrong)
    assert "over all cells" in check_training(partial(trained, flaw="kept")).hint
