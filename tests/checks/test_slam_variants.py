"""Right and wrong answers to the exercises of notebook 08."""

import numpy as np
import pytest
import torch

from minislam.checks import check_ate, check_separability
from minislam.geometry.alignment import umeyama
from tests.helpers import assert_variants


def aligned(estimate, truth, with_scale=True):
    return umeyama(estimate, truth, with_scale).transform_points(estimate)


def rms(difference):
    return np.sqrt((difference**2).sum(1).mean())


def in_a_loop(estimate, truth):
    squares = [
        float(sum((a - b) ** 2)) for a, b in zip(aligned(estimate, truth), truth, strict=True)
    ]
    return (sum(squares) / len(squares)) ** 0.5


def with_torch(estimate, truth):
    return torch.tensor(aligned(estimate, truth) - truth).square().sum(1).mean().sqrt()


@pytest.mark.ex08_1
def test_ate():
    right = {"loop": in_a_loop, "torch": with_torch}
    wrong = {
        "not aligned": lambda e, t: rms(e - t),
        "centred": lambda e, t: rms(e - e.mean(0) - t + t.mean(0)),
        "no scale": lambda e, t: rms(aligned(e, t, False) - t),
        "mean": lambda e, t: np.linalg.norm(aligned(e, t) - t, axis=1).mean(),
        "median": lambda e, t: np.median(np.linalg.norm(aligned(e, t) - t, axis=1)),
        "largest": lambda e, t: np.linalg.norm(aligned(e, t) - t, axis=1).max(),
        "the other way": lambda e, t: rms(aligned(t, e) - e),
        "of coordinates": lambda e, t: np.sqrt(((aligned(e, t) - t) ** 2).mean()),
        "squared": lambda e, t: rms(aligned(e, t) - t) ** 2,
        "a norm": lambda e, t: np.linalg.norm(aligned(e, t) - t),
        "one a camera": lambda e, t: np.linalg.norm(aligned(e, t) - t, axis=1),
    }
    assert_variants(check_ate, right, wrong)


def separability(beta, moving, tie=0.5):
    won = [float(a > b) + tie * (a == b) for a in beta[moving] for b in beta[~moving]]
    return sum(won) / len(won)


def by_ranks(beta, moving):
    ranks = np.array([(beta < b).sum() + ((beta == b).sum() + 1) / 2 for b in beta])
    n, m = moving.sum(), (~moving).sum()
    return (ranks[moving].sum() - n * (n + 1) / 2) / (n * m)


def accuracy(beta, moving):
    return ((beta > np.median(beta)) == moving).mean()


@pytest.mark.ex08_2
def test_separability():
    right = {"loop": separability, "ranks": by_ranks}
    wrong = {
        "the other way round": lambda b, m: separability(b, ~m),
        "a tie is lost": lambda b, m: separability(b, m, 0),
        "a tie is won": lambda b, m: separability(b, m, 1),
        "a number of pairs": lambda b, m: separability(b, m) * m.sum() * (~m).sum(),
        "of all pairs": lambda b, m: separability(b, m) * m.sum() * (~m).sum() / len(b) ** 2,
        "of the means": lambda b, m: b[m].mean() - b[~m].mean(),
        "accuracy": accuracy,
        "correlation": lambda b, m: np.corrcoef(b, m)[0, 1],
        "of the sums": lambda b, m: b[m].sum() / b.sum(),
    }
    assert_variants(check_separability, right, wrong)
