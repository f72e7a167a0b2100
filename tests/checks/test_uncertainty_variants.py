"""Right and wrong answers to the exercises of notebook 04."""

import math

import pytest
import torch

from minislam.checks import check_best_beta, check_feature_variance
from tests.helpers import assert_variants


@pytest.mark.ex04_1
def test_best_beta():
    right = {
        "torch": lambda L, x: (2 * L / x).sqrt(),
        "list of floats": lambda L, x: [math.sqrt(2 * error / x) for error in L],
        "float32": lambda L, x: torch.sqrt(2 * L.float() / x),
        "numpy": lambda L, x: (2 * L.numpy() / x) ** 0.5,
    }
    wrong = {
        "no lambda": lambda L, x: L.sqrt(),
        "no 2": lambda L, x: (L / x).sqrt(),
        "squared": lambda L, x: 2 * L / x,
        "upside down": lambda L, x: (L * x / 2).sqrt(),
        "times lambda": lambda L, x: (2 * L * x).sqrt(),
        "with a floor": lambda L, x: (2 * L / x).sqrt().clamp_min(0.1),
        "negative": lambda L, x: -(2 * L / x).sqrt(),
        "the least loss": lambda L, x: 0.5 * x * (1 + (2 * L / x).log()),
        "one for all": lambda L, x: (2 * L / x).sqrt().mean(),
    }
    assert_variants(check_best_beta, right, wrong)


def variance(beta, features, threshold=0.75, normal=True, itself=True, less=0, root=False):
    unit = torch.nn.functional.normalize(features, dim=1) if normal else features
    total = 0.0
    for i in range(len(beta)):
        near = [j for j in range(len(beta)) if unit[i] @ unit[j] > threshold and (itself or j != i)]
        if len(near) > less:
            mean = sum(beta[j] for j in near) / len(near)
            own = sum((beta[j] - mean) ** 2 for j in near) / (len(near) - less)
            total = total + (own**0.5 if root else own)
    return float(total) / len(beta)


def with_float_mask(beta, features):  # mixes dtypes where beta is float64
    unit = features / features.norm(dim=1, keepdim=True)
    near = (unit @ unit.T > 0.75).float()
    mean = near @ beta / near.sum(1)
    return (near @ beta**2 / near.sum(1) - mean**2).mean()


def around_all(beta, features):
    unit = features / features.norm(dim=1, keepdim=True)
    near = (unit @ unit.T > 0.75).to(beta)
    return (near @ (beta - beta.mean()) ** 2 / near.sum(1)).mean()


@pytest.mark.ex04_2
def test_feature_variance():
    right = {"loop": variance, "float mask": with_float_mask}
    wrong = {
        "all cells": lambda b, f: variance(b, f, threshold=-2),
        "not normalised": lambda b, f: variance(b, f, normal=False),
        "deviation": lambda b, f: variance(b, f, root=True),
        "unbiased": lambda b, f: variance(b, f, less=1),
        "without itself": lambda b, f: variance(b, f, itself=False),
        "mean of all": around_all,
        "summed": lambda b, f: len(b) * variance(b, f),
        "another threshold": lambda b, f: variance(b, f, threshold=0.5),
        "for each cell": lambda b, f: (b - b.mean()) ** 2,
    }
    assert_variants(check_feature_variance, right, wrong)
