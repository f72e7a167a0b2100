"""The checks of notebook 09: right answers in any style pass, known mistakes are named."""

import numpy as np
import pytest
import torch

from minislam.checks import PASSED, WRONG, check_gains, check_stride

# Gains


def gains_of_numpy(first, second):
    first, second = np.asarray(first), np.asarray(second)
    both = (np.minimum(first, second) > 0.05) & (np.maximum(first, second) < 0.95)
    return [np.median((second / first)[both[:, k], k]) for k in range(3)]


def gains_of_nan(first, second):
    bad = (first <= 0.05) | (first >= 0.95) | (second <= 0.05) | (second >= 0.95)
    return torch.where(bad, torch.nan, second / first).nanquantile(0.5, dim=0)


def within(first, second, lowest, highest):
    both = (torch.minimum(first, second) > lowest) & (torch.maximum(first, second) < highest)
    return torch.where(both, second / first, torch.nan).nanquantile(0.5, dim=0)


def lower_median(first, second):
    bad = (first <= 0.05) | (first >= 0.95) | (second <= 0.05) | (second >= 0.95)
    return torch.where(bad, torch.nan, second / first).nanmedian(0).values


def usable_in_all_channels(first, second):
    usable = ((torch.minimum(first, second) > 0.05) & (torch.maximum(first, second) < 0.95)).all(1)
    return gains_of_nan(first[usable], second[usable])


WRONG_GAINS = [
    (usable_in_all_channels, "own usable points"),
    (lower_median, "lower of two"),
    (lambda a, b: (b / a).quantile(0.5, dim=0), "Saturated"),
    (lambda a, b: gains_of_nan(b, a), "from the second frame to the first"),
    (lambda a, b: (b / a).mean(0), "take the median"),
    (lambda a, b: gains_of_nan(a, b).mean().expand(3), "gain of its own"),
    (lambda a, b: within(a, b, -1.0, 0.95), "nearly all noise"),
    (lambda a, b: within(a, b, 0.05, 2.0), "cut off"),
    (lambda a, b: gains_of_nan(a, b).log(), ""),
    (lambda a, b: b.sum(0) / a.sum(0), ""),
]


@pytest.mark.ex09_1
@pytest.mark.parametrize("answer", [gains_of_numpy, gains_of_nan])
def test_right_gains_pass(answer):
    assert check_gains(answer).status == PASSED


@pytest.mark.ex09_1
@pytest.mark.parametrize("answer, words", WRONG_GAINS)
def test_wrong_gains_are_refused(answer, words):
    verdict = check_gains(answer)
    assert verdict.status == WRONG and words in verdict.hint


# Stride


def half(lengths):
    return lengths.quantile(0.5)


def stride_of_torch(
    rays, flows, strides, needed, least=0.5, power=1.0, rounds=10, square=1.0, middle=half
):
    x, y = rays.T
    across = torch.stack([-x * y, 1 + square * x * x, -y], 1)
    down = torch.stack([-(1 + square * y * y), x * y, x], 1)
    matrix = torch.stack([across, down], 1)  # (N, 2, 3)
    parallaxes = []
    for of_stride in flows:
        lengths = []
        for flow in of_stride:
            weight, rest = torch.ones_like(x), flow
            for _ in range(rounds):
                H = torch.einsum("n,nki,nkj->ij", weight, matrix, matrix)
                g = torch.einsum("n,nki,nk->i", weight, matrix, flow)
                rest = flow - matrix @ torch.linalg.solve(H, g)
                weight = 1 / rest.norm(dim=1).clamp_min(least) ** power
            lengths.append(middle(rest.norm(dim=1)))
        parallaxes.append(middle(torch.stack(lengths)))
    enough = [s for s, p in zip(strides, parallaxes, strict=True) if p >= needed]
    return torch.stack(parallaxes), enough[0] if enough else 0


def stride_of_numpy(rays, flows, strides, needed):
    rays, flows = np.asarray(rays), np.asarray(flows)
    rows = []
    for x, y in rays:
        rows += [[-x * y, 1 + x * x, -y], [-1 - y * y, x * y, x]]
    matrix, parallaxes, best = np.array(rows), [], 0
    for stride, of_stride in zip(strides, flows, strict=True):
        found = []
        for flow in of_stride:
            weight = np.ones(len(rays))
            for _ in range(10):
                root = np.sqrt(np.repeat(weight, 2))[:, None]
                turn = np.linalg.lstsq(root * matrix, root[:, 0] * flow.ravel(), rcond=None)[0]
                rest = np.hypot(*(flow.ravel() - matrix @ turn).reshape(-1, 2).T)
                weight = 1 / np.maximum(rest, 0.5)
            found.append(np.median(rest))
        parallaxes.append(float(np.median(found)))
        if best == 0 and parallaxes[-1] >= needed:
            best = stride
    return parallaxes, best


def changed(change):
    def answer(rays, flows, strides, needed):
        return change(*stride_of_torch(rays, flows, strides, needed), strides)

    return answer


def options(**changes):
    return lambda *arguments: stride_of_torch(*arguments, **changes)


def whole(rays, flows, strides, needed):
    found = flows.norm(dim=-1).quantile(0.5, dim=-1).quantile(0.5, dim=-1)
    return found, next((s for s, p in zip(strides, found, strict=True) if p >= needed), 0)


WRONG_STRIDES = [
    (options(rounds=1), "ten times"),
    (options(rounds=11), "Ten fits in all"),
    (options(power=2.0), "1/residual^2"),
    (options(square=0.0), "1 + x^2"),
    (options(middle=torch.median), "lower of two"),
    (whole, "whole flow"),
    (changed(lambda p, s, strides: (p, strides[-1] if s else 0)), "smallest"),
    (changed(lambda p, s, strides: (p, s or strides[-1])), "the answer is 0"),
    (changed(lambda p, s, strides: (p, strides.index(s) if s else 0)), "place in the list"),
    (changed(lambda p, s, strides: (p**2, s)), ""),
    (options(least=5.0), ""),
]


@pytest.mark.ex09_2
@pytest.mark.parametrize("answer", [stride_of_torch, stride_of_numpy])
def test_right_strides_pass(answer):
    assert check_stride(answer).status == PASSED


@pytest.mark.ex09_2
@pytest.mark.parametrize("answer, words", WRONG_STRIDES)
def test_wrong_strides_are_refused(answer, words):
    verdict = check_stride(answer)
    assert verdict.status == WRONG and words in verdict.hint
