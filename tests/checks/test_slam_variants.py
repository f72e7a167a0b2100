"""Right and wrong answers to the exercises of notebook 08."""

import numpy as np
import pytest
import torch

from minislam.checks import check_alignment, check_ate, check_separability, check_sign_test
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


def similarity(estimate, truth, mirror=False, spread=False, **how):
    """Return the best Sim(3) as a matrix, with the mistake that is asked for."""
    e, t = estimate - estimate.mean(0), truth - truth.mean(0)
    u, d, v = np.linalg.svd(t.T @ e)
    signs = np.array([1, 1, 1 if mirror else np.sign(np.linalg.det(u @ v))])
    trace = d.sum() if how.get("unsigned") else (d * signs).sum()
    scale = np.sqrt((t**2).sum() / (e**2).sum()) if spread else trace / (e**2).sum()
    A = np.eye(4)
    turn = (u * signs) @ v
    A[:3, :3] = how.get("scale", scale) * (turn.T if how.get("transposed") else turn)
    A[:3, 3] = truth.mean(0) - (np.eye(3) if how.get("unturned") else A[:3, :3]) @ estimate.mean(0)
    return A


def by_umeyama(estimate, truth):
    found = umeyama(estimate, truth)
    last = torch.tensor([[0, 0, 0, 1.0]])
    upper = np.hstack([found.scale * found.rotation, found.translation[:, None]])
    return torch.cat([torch.tensor(upper), last.double()])


@pytest.mark.ex08_3
def test_alignment():
    wrong = {
        "no scale": lambda e, t: similarity(e, t, scale=1.0),
        "reflection": lambda e, t: similarity(e, t, mirror=True),
        "ratio of spreads": lambda e, t: similarity(e, t, spread=True),
        "truth to estimate": lambda e, t: similarity(t, e),
        "inverse": lambda e, t: np.linalg.inv(similarity(e, t)),
        "mean not turned": lambda e, t: similarity(e, t, unturned=True),
        "transposed": lambda e, t: similarity(e, t, transposed=True),
        "no S in the scale": lambda e, t: similarity(e, t, unsigned=True),
    }
    assert_variants(check_alignment, {"svd": similarity, "torch": by_umeyama}, wrong, 1.0)


def chance(a, b, slack=1e-12, one_sided=False):
    d = np.asarray(a) - np.asarray(b)
    signs = np.array(np.meshgrid(*[[1, -1]] * len(d))).reshape(len(d), -1)
    means = d @ signs / len(d)
    if one_sided:
        return np.mean(means * np.sign(d.mean()) >= abs(d.mean()) - slack)
    return np.mean(abs(means) >= abs(d.mean()) - slack)


def chance_in_a_loop(a, b):
    d, count = [float(x - y) for x, y in zip(a, b, strict=True)], 0
    for k in range(2 ** len(d)):
        total = sum(x if k >> n & 1 else -x for n, x in enumerate(d))
        count += abs(total) >= abs(sum(d)) - 1e-12
    return count / 2 ** len(d)


@pytest.mark.ex10_1
def test_sign_test():
    wrong = {
        "one-sided": lambda a, b: chance(a, b, one_sided=True),
        "farther": lambda a, b: chance(a, b, slack=-1e-9),
        "not up to rounding": lambda a, b: chance(a, b, slack=0.0),
        "the others": lambda a, b: 1 - chance(a, b),
        "a count": lambda a, b: chance(a, b) * 2 ** len(a),
        "mean difference": lambda a, b: float(np.mean(a - b)),
        "the classical sign test": lambda a, b: chance(np.sign(a - b), 0 * a),
        "which are better": lambda a, b: float(np.mean(a < b)),
    }
    assert_variants(check_sign_test, {"vectors": chance, "loop": chance_in_a_loop}, wrong, 0.6)
