"""Exercises of notebooks 08 and 10."""

from itertools import product
from typing import Any

import numpy as np

from minislam.checks.cases import Case, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.evaluation.images import auroc
from minislam.geometry.alignment import umeyama


def check_ate(student: Function) -> Verdict:
    """Check (estimated (N, 3), true camera centres (N, 3)) -> ATE after the best Sim(3)."""

    def distances(estimate: np.ndarray, truth: np.ndarray, with_scale: bool = True) -> np.ndarray:
        aligned = umeyama(estimate, truth, with_scale).transform_points(estimate)
        return np.linalg.norm(aligned - truth, axis=1)

    def rms(errors: np.ndarray) -> float:  # (N,) or (N, 3)
        return float(np.sqrt(np.sum(errors**2) / len(errors)))

    def reference(estimate: np.ndarray, truth: np.ndarray) -> float:
        return rms(distances(estimate, truth))

    def case(scale: float, turned: bool, description: str, seed: int = 0) -> Case:
        source = np.random.default_rng(seed)
        truth = np.cumsum(source.normal(size=(20, 3)), axis=0)
        estimate = scale * (truth + 0.1 * source.normal(size=(20, 3)))
        if turned:
            estimate = estimate[:, [2, 0, 1]] + np.array([3.0, -1.0, 2.0])  # z to x, x to y, y to z
        return Case((estimate, truth), description)

    cases = [
        case(1.0, False, "an estimate in the right frame"),
        case(0.25, False, "an estimate in another unit"),
        case(0.25, True, "an estimate in another unit and frame"),
        *drawn(lambda seed: case(0.5 + seed % 3, seed % 2 == 0, "another walk", seed)),
    ]
    mistakes = [
        (lambda e, t: rms(e - t), "The estimate is not aligned yet."),
        (lambda e, t: rms(distances(e, t, False)), "A monocular estimate has no scale: align it."),
        (lambda e, t: distances(e, t).mean(), "ATE is the root of the mean square."),
        (lambda e, t: np.median(distances(e, t)), "ATE is the root of the mean square."),
        (lambda e, t: rms(distances(t, e)), "The truth has been mapped to the estimate."),
        (lambda e, t: reference(e, t) ** 2, "The root is missing."),
        (lambda e, t: reference(e, t) / 3**0.5, "A mean over cameras, not over their 3 N numbers."),
        (lambda e, t: reference(e, t) * len(t) ** 0.5, "The mean is missing: divide by N."),
        (lambda e, t: rms(e - t - (e - t).mean(0)), "Centred, but neither turned nor scaled yet."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_separability(student: Function) -> Verdict:
    """Check (beta (N,), True on dynamic objects (N,)) -> the AUROC of beta."""

    def wins(beta: np.ndarray, moving: np.ndarray, tie: float) -> float:
        pairs = beta[moving][:, None] - beta[~moving]
        return float(np.mean(np.where(pairs == 0, tie, pairs > 0)))

    def case(beta: Any, moving: Any, description: str) -> Case:
        return Case((np.array(beta), np.array(moving) > 0), description)

    def draw(seed: int) -> Case:
        moving = np.arange(12) < 3 + seed % 4
        beta = np.round(np.random.default_rng(seed).uniform(0, 1, 12) + 0.3 * moving, 1)
        return case(beta, moving, "12 cells, some of them alike")

    cases = [
        case([0.1, 0.9, 0.4, 0.7, 0.2], [0, 1, 0, 1, 1], "three cells of a person, two of a wall"),
        case([0.5, 0.5, 0.8, 0.3], [1, 0, 1, 0], "a beta that does not tell two cells apart"),
        *drawn(draw),
    ]
    mistakes = [
        (lambda b, m: wins(b, ~m, 0.5), "The other way round: what moves has the larger beta."),
        (lambda b, m: wins(b, m, 0.0), "A pair with equal beta is worth one half."),
        (lambda b, m: wins(b, m, 1.0), "A pair with equal beta is worth one half."),
        (lambda b, m: wins(b, m, 0.5) * m.sum() * (~m).sum(), "Divide by the number of pairs."),
        (lambda b, m: wins(b, m, 0.5) * m.mean() * (~m).mean(), "Count only mixed pairs."),
        (lambda b, m: b[m].mean() - b[~m].mean(), "This is a difference of means, no fraction."),
        (lambda b, m: ((b > np.median(b)) == m).mean(), "No threshold: compare all pairs."),
    ]
    return check_function(student, auroc, cases, 1e-9, mistakes)


def check_alignment(student: Function) -> Verdict:
    """Check (estimated (N, 3), true centres (N, 3)) -> the best Sim(3) as [s R, t; 0, 1] (4, 4)."""

    def aligned(e: np.ndarray, t: np.ndarray, flaw: str = "") -> np.ndarray:
        best, centred = umeyama(e, t), e - e.mean(0)
        R, scale, spread = best.rotation, best.scale, (centred**2).sum()
        u, d, v = np.linalg.svd((t - t.mean(0)).T @ centred)
        R = u @ v if flaw == "mirrored" else R
        scale = d.sum() / spread if flaw in ("mirrored", "unsigned") else scale
        scale = {"spread": np.sqrt(len(t) * t.var(0).sum() / spread), "1": 1.0}.get(flaw, scale)
        A = np.eye(4)
        A[:3, :3] = scale * (R.T if flaw == "transposed" else R)
        A[:3, 3] = t.mean(0) - (e.mean(0) if flaw == "unturned" else A[:3, :3] @ e.mean(0))
        return A

    def case(
        scale: float, noise: float, mirror: float, count: int, description: str, seed: int = 4
    ) -> Case:
        source = np.random.default_rng(seed)
        truth = np.cumsum(source.normal(size=(count, 3)), axis=0) * [1.0, 0.6, 0.2]
        seen = (truth + noise * source.normal(size=truth.shape)) * [1, 1, mirror]
        return Case((scale * seen[:, [2, 0, 1]] + [3.0, -1.0, 2.0], truth), description)

    cases = [
        case(1.0, 0.0, 1.0, 20, "an estimate in another frame"),
        case(0.25, 0.0, 1.0, 20, "an estimate in another unit and frame"),
        case(0.25, 0.3, 1.0, 20, "an estimate with errors"),
        case(2.0, 0.1, -1.0, 20, "points that a reflection would fit better"),
        case(2.0, 0.1, 1.0, 3, "three points"),
        *drawn(lambda seed: case(0.5 + seed % 3, 0.2, 1.0, 9, "a drawn path", seed)),
    ]
    mistakes = [
        ("1", "Monocular: the scale is unknown."),
        ("mirrored", "A rotation has determinant +1: turn the last column of U if it is -1."),
        ("unsigned", "S stands in the scale as well: trace(D S)."),
        ("spread", "With errors s is trace(D S) over the variance of the estimate."),
        (lambda e, t: np.linalg.inv(aligned(e, t)), "This maps the truth to the estimate."),
        (lambda e, t: aligned(t, e), "This maps the truth to the estimate."),
        ("unturned", "t maps the TURNED and scaled mean of the estimate to that of the truth."),
        ("transposed", "This is R^T."),
    ]
    return check_function(student, aligned, cases, 1e-9, mistakes)


def check_sign_test(student: Function) -> Verdict:
    """Check (errors with, errors without (N,)) -> how often chance does at least as much.

    Of all 2^N signs of the differences, the part whose mean is at least as far from 0 as measured.
    """

    def reference(a: np.ndarray, b: np.ndarray, slack: float = 1e-12, sided: int = 2) -> float:
        d = a - b
        means = np.array([np.mean(d * signs) for signs in product([1, -1], repeat=len(d))])
        far = np.abs(means) if sided == 2 else means * np.sign(d.mean())
        return float((far >= abs(d.mean()) - slack).mean())

    of_clips = {
        "three clips that all get better": [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]],
        "four clips, two get worse": [[0.6, 0.9, 0.3, 0.8], [0.5, 0.6, 0.7, 2.8]],
        "four clips, sums that are rounded": [[0.1, 0.2, 0.0, 0.6], [0.0, 0.0, 0.3, 0.0]],
        "a single clip": [[2.0], [1.0]],
        "no difference at all": [[1.0, 2.0, 1.5], [1.0, 2.0, 1.5]],
    }

    def draw(seed: int) -> Case:
        return Case((*normals(seed, 2, 3 + seed % 5).abs().numpy(),), "drawn errors")

    cases = [Case((*np.array(errors),), name) for name, errors in of_clips.items()]
    cases += drawn(draw)
    mistakes = [
        (lambda a, b: reference(a, b, sided=1), "A difference the other way is as surprising."),
        (lambda a, b: reference(a, b, -1e-12), "At least as far: the measured one counts as well."),
        (lambda a, b: 1 - reference(a, b), "This is the fraction of the others."),
        (lambda a, b: reference(np.sign(a - b), 0 * b), "This counts signs: compare the means."),
        (lambda a, b: reference(a, b) * 2 ** len(a), "Divide by the number of choices, 2^N."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)
