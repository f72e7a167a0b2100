"""Right and wrong answers to the exercise of the notebook about dense structure."""

import numpy as np
import pytest
import torch

from minislam.checks import check_plane_homography
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
