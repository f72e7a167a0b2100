"""Exercises of notebook 08."""

from collections.abc import Callable

import numpy as np

from minislam.checks.grading import Case, Hints, Verdict, check_function
from minislam.evaluation.images import auroc
from minislam.geometry.alignment import umeyama


def check_ate(student: Callable[[np.ndarray, np.ndarray], float]) -> Verdict:
    """Check (estimated (N, 3), true camera centres (N, 3)) -> ATE after the best Sim(3)."""

    def distances(estimate: np.ndarray, truth: np.ndarray, with_scale: bool = True) -> np.ndarray:
        aligned = umeyama(estimate, truth, with_scale).transform_points(estimate)
        return np.linalg.norm(aligned - truth, axis=1)

    def rms(errors: np.ndarray) -> float:  # (N,) or (N, 3)
        return float(np.sqrt(np.sum(errors**2) / len(errors)))

    def centred(positions: np.ndarray) -> np.ndarray:
        return positions - positions.mean(0)

    def reference(estimate: np.ndarray, truth: np.ndarray) -> float:
        return rms(distances(estimate, truth))

    def case(scale: float, turned: bool, description: str, seed: int = 0) -> Case:
        source = np.random.default_rng(seed)
        truth = np.cumsum(source.normal(size=(20, 3)), axis=0)
        estimate = scale * (truth + 0.1 * source.normal(size=(20, 3)))
        if turned:
            estimate = estimate[:, [2, 0, 1]] + np.array([3.0, -1.0, 2.0])  # z to x, x to y, y to z
        return Case((estimate, truth), description)

    def draw(seed: int) -> Case:
        return case(0.5 + seed % 3, seed % 2 == 0, "another walk", seed)

    cases = [
        case(1.0, False, "an estimate in the right frame"),
        case(0.25, False, "an estimate in another unit"),
        case(0.25, True, "an estimate in another unit and frame"),
    ]
    hints: Hints = [
        (lambda e, t: rms(e - t), "The estimate is not aligned yet."),
        (lambda e, t: rms(distances(e, t, False)), "A monocular estimate has no scale: align it."),
        (lambda e, t: float(distances(e, t).mean()), "ATE is the root of the mean square."),
        (lambda e, t: float(np.median(distances(e, t))), "ATE is the root of the mean square."),
        (lambda e, t: rms(distances(t, e)), "The truth has been mapped to the estimate."),
        (lambda e, t: reference(e, t) ** 2, "The root is missing."),
        (lambda e, t: reference(e, t) / 3**0.5, "A mean over cameras, not over their 3 N numbers."),
        (lambda e, t: reference(e, t) * len(t) ** 0.5, "The mean is missing: divide by N."),
        (lambda e, t: float(distances(e, t).max()), "ATE is no maximum."),
        (lambda e, t: rms(centred(e) - centred(t)), "Centred, but neither turned nor scaled yet."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_separability(student: Callable[[np.ndarray, np.ndarray], float]) -> Verdict:
    """Check (beta (N,), True on dynamic objects (N,)) -> the AUROC of beta."""

    def wins(beta: np.ndarray, moving: np.ndarray, draw: float) -> float:
        pairs = beta[moving][:, None] - beta[~moving]
        return float(np.mean(np.where(pairs == 0, draw, pairs > 0)))

    cases = [
        Case(
            (np.array([0.1, 0.9, 0.4, 0.7, 0.2]), np.array([False, True, False, True, True])),
            "three cells of a person and two of a wall",
        ),
        Case(
            (np.array([0.5, 0.5, 0.8, 0.3]), np.array([True, False, True, False])),
            "a beta that does not tell two cells apart",
        ),
    ]

    def draw(seed: int) -> Case:
        source = np.random.default_rng(seed)
        moving = np.arange(12) < 3 + seed % 4
        beta = np.round(source.uniform(0, 1, 12) + 0.3 * moving, 1)
        return Case((beta, moving), "12 cells, some of them alike")

    def count(beta: np.ndarray, moving: np.ndarray) -> float:
        return wins(beta, moving, 0.5) * moving.sum() * (~moving).sum()

    def at_the_median(beta: np.ndarray, moving: np.ndarray) -> float:
        return float(np.mean((beta > np.median(beta)) == moving))

    hints: Hints = [
        (lambda b, m: wins(b, ~m, 0.5), "The other way round: what moves has the larger beta."),
        (lambda b, m: wins(b, m, 0.0), "A pair with equal beta is worth one half."),
        (lambda b, m: wins(b, m, 1.0), "A pair with equal beta is worth one half."),
        (count, "The number of pairs is missing: divide by it."),
        (lambda b, m: count(b, m) / len(b) ** 2, "Only pairs of a moving and a static cell count."),
        (lambda b, m: b[m].mean() - b[~m].mean(), "This is a difference of means, no fraction."),
        (at_the_median, "No threshold is asked for: compare all pairs."),
    ]
    return check_function(student, auroc, cases, 1e-9, hints, draw)
