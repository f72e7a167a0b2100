"""Right and wrong answers to the exercise of the notebook about dense structure."""

import cv2
import numpy as np
import pytest
import torch

from minislam.checks import check_plane_cost, check_plane_homography
from tests.helpers import assert_variants


def homography(K, T, q):
    normal = torch.tensor([[0.0, 0.0, 1.0]]).to(K)
    return K @ (T[:3, :3] + q * T[:3, 3:] @ normal) @ torch.linalg.inv(K)


def with_numpy(K, T, q):
    K, T = K.double().numpy(), T.double().numpy()
    return K @ (T[:3, :3] + q * np.outer(T[:3, 3], [0, 0, 1])) @ np.linalg.inv(K)


def by_points(K, T, q):
    """Solve for H from where three directions go."""
    uv = torch.eye(3).to(K) + torch.tensor([[1.0], [2.0], [3.0]]).to(K)
    rays = torch.linalg.solve(K, uv)
    seen = K @ (T[:3, :3] @ rays + q * T[:3, 3:] * rays[2:])
    return seen @ torch.linalg.inv(uv)


def other_row(K, T, q):
    normal = torch.tensor([[0.0], [0.0], [1.0]]).to(K)
    return K @ (T[:3, :3] + q * normal @ T[:3, 3:].T) @ torch.linalg.inv(K)


@pytest.mark.ex07b_1
def test_plane_homography():
    right = {"outer product": homography, "numpy": with_numpy, "points": by_points}
    wrong = {
        "the way back": lambda K, T, q: homography(K, torch.linalg.inv(T), q),
        "depth": lambda K, T, q: homography(K, T, 1 / q if q else 0.0),
        "no K": lambda K, T, q: homography(torch.eye(3).to(K), T, q),
        "sign of t": lambda K, T, q: homography(K, T, -q),
        "no t": lambda K, T, q: homography(K, T, 0.0),
        "t n^T transposed": other_row,
        "inverse": lambda K, T, q: torch.linalg.inv(homography(K, T, q)),
        "no inverse of K": lambda K, T, q: homography(K, T, q) @ K @ K,
        "K on one side": lambda K, T, q: homography(K, T, q) @ K,
        "R transposed": lambda K, T, q: homography(K, torch.block_diag(T[:3, :3].T, T[3:, 3:]), q),
    }
    assert_variants(check_plane_homography, right, wrong)


def plane_cost(gray, warped, window=5, worst=False, every=False, **how):
    """Return the cost of a plane, with the mistake that is asked for."""
    seen = (warped >= 0) | how.get("unmasked", False)
    difference = np.where(seen, np.abs(warped - gray), 0)
    costs = np.array([cv2.blur(picture, (window, window)) for picture in difference])
    ordered = np.sort(np.where(seen, costs, -np.inf if worst else np.inf), 0)
    ordered = ordered[::-1] if worst else ordered
    number = seen.sum(0)
    taken = number if every else (number + 1 - how.get("down", 0)) // 2
    inside = np.arange(len(warped))[:, None, None] < np.maximum(taken, 1)
    total = np.where(inside & np.isfinite(ordered), ordered, 0).sum(0)
    return np.where(number > 0, total / np.maximum(taken, 1), how.get("unseen", 1.0))


def plane_cost_in_a_loop(gray, warped):
    views = [
        cv2.blur(np.where(view >= 0, np.abs(view - gray), 0), (5, 5)).tolist() for view in warped
    ]
    answer = []
    for v in range(gray.shape[0]):
        for u in range(gray.shape[1]):
            costs = sorted(views[n][v][u] for n in range(len(warped)) if warped[n, v, u] >= 0)
            half = costs[: (len(costs) + 1) // 2]
            answer.append(sum(half) / len(half) if half else 1.0)
    return torch.tensor(answer).reshape(gray.shape)


@pytest.mark.ex07b_2
def test_plane_cost():
    ways = {
        "no window": {"window": 1},
        "worse half": {"worst": True},
        "all views": {"every": True},
        "rounded down": {"down": 1},
        "unseen costs nothing": {"unseen": 0.0},
        "outside counts": {"unmasked": True},
        "window of 3": {"window": 3},
    }
    wrong = {name: (lambda g, w, how=how: plane_cost(g, w, **how)) for name, how in ways.items()}
    right = {"sorted": plane_cost, "loop": plane_cost_in_a_loop}
    assert_variants(check_plane_cost, right, wrong)
