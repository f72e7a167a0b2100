"""The check of notebook 09: the right answer passes, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import WRONG, check_plane_homography
from tests.helpers import assert_graded


def homography(K: Tensor, T: Tensor, q: float) -> Tensor:
    motion = T[:3, :3].clone()
    motion[:, 2] += q * T[:3, 3]
    return K @ motion @ torch.linalg.inv(K)


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_plane_homography, homography)


def test_known_mistakes_are_named():
    back = check_plane_homography(lambda K, T, q: homography(K, torch.linalg.inv(T), q))
    assert "the way back" in back.sentence
    depth = check_plane_homography(lambda K, T, q: homography(K, T, 1 / q if q else 0.0))
    assert "an inverse depth" in depth.sentence
    bare = check_plane_homography(lambda K, T, q: homography(torch.eye(3).double(), T, q))
    assert "K on both sides" in bare.sentence
    sign = check_plane_homography(lambda K, T, q: homography(K, T, -q))
    assert "sign" in sign.sentence
    rotation_only = check_plane_homography(lambda K, T, q: homography(K, T, 0.0))
    assert rotation_only.status == WRONG
