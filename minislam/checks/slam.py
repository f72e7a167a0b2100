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

    def rms(lengths: np.ndarray) -> float:
        return float(np.sqrt(np.mean(lengths**2)))

    def reference(estimate: np.ndarray, truth: np.ndarray) -> float:
        return rms(distances(estimate, truth))

    def case(scale: float, turned: bool, description: str) -> Case:
        source = np.random.default_rng(0)
        truth = np.cumsum(source.normal(size=(20, 3)), axis=0)
        estimate = scale * (truth + 0.1 * source.normal(size=(20, 3)))
        if turned:
            estimate = estimate[:, [2, 0, 1]] + np.array([3.0, -1.0, 2.0])  # z to x, x to y, y to z
        return Case((estimate, truth), description)

    cases = [
        case(1.0, False, "an estimate in the right frame"),
        case(0.25, False, "an estimate in another unit"),
        case(0.25, True, "an estimate in another unit and frame"),
    ]
    hints: Hints = [
        (lambda e, t: rms(np.linalg.norm(e - t, axis=1)), "The estimate is not aligned yet."),
        (lambda e, t: rms(distances(e, t, False)), "A monocular estimate has no scale: align it."),
        (lambda e, t: float(distances(e, t).mean()), "ATE is the root of the mean square."),
        (lambda e, t: float(np.median(distances(e, t))), "ATE is the root of the mean square."),
        (lambda e, t: rms(distances(t, e)), "The truth has been mapped to the estimate."),
    ]
    return check_function(student, reference, cases, tolerance=1e-9, hints=hints)


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
    hints: Hints = [
        (lambda b, m: wins(b, ~m, 0.5), "The other way round: what moves has the larger beta."),
        (lambda b, m: wins(b, m, 0.0), "A pair with equal beta is worth one half."),
        (lambda b, m: wins(b, m, 1.0), "A pair with equal beta is worth one half."),
    ]
    return check_function(student, auroc, cases, tolerance=1e-9, hints=hints)
