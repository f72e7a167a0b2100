"""The checks of notebook 08: right answers pass, known mistakes are named."""

import numpy as np

from minislam.checks import check_ate, check_separability
from tests.helpers import assert_graded


def procrustes(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimate turned and centred like the truth, not yet scaled, and the truth."""
    estimate, truth = estimate - estimate.mean(0), truth - truth.mean(0)
    u, _, v = np.linalg.svd(truth.T @ estimate)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return estimate @ turn.T, truth


def ate(estimate: np.ndarray, truth: np.ndarray) -> float:
    estimate, truth = procrustes(estimate, truth)
    scale = (estimate * truth).sum() / (estimate**2).sum()
    return float(np.sqrt(((scale * estimate - truth) ** 2).sum(1).mean()))


def separability(beta: np.ndarray, moving: np.ndarray) -> float:
    won = [float(a > b) + 0.5 * float(a == b) for a in beta[moving] for b in beta[~moving]]
    return float(np.mean(won))


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_ate, ate)
    assert_graded(check_separability, separability)


def test_known_mistakes_of_evaluation_are_named():
    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt((difference**2).sum(1).mean()))

    unscaled = check_ate(lambda e, t: rms(np.subtract(*procrustes(e, t))))
    assert "no scale" in unscaled.sentence
    assert "not aligned" in check_ate(lambda e, t: rms(e - t)).sentence
    assert "mapped to the estimate" in check_ate(lambda e, t: ate(t, e)).sentence
    assert "one half" in check_separability(
        lambda b, m: float((b[m][:, None] > b[~m]).mean())
    ).sentence  # fmt: skip
    assert "other way round" in check_separability(lambda b, m: separability(b, ~m)).sentence
