"""The checks of notebooks 02 and 03: right answers pass, known mistakes are named."""

import torch
from torch import Tensor

from minislam.checks import (
    check_conic_vjp,
    check_pixel_color,
    check_projected_covariance,
    check_twist_vjp,
)
from minislam.geometry import Camera
from tests.helpers import assert_graded


def projected(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
    to_pixels = camera.project_jacobian(pose[:3, :3] @ mean + pose[:3, 3]) @ pose[:3, :3]
    return to_pixels @ covariance @ to_pixels.T + 0.3 * torch.eye(2, dtype=torch.float64)


def blended(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
    for alpha, color in zip(alphas.flip(0), colors.flip(0), strict=True):  # from the back
        background = alpha * color + (1 - alpha) * background
    return background


def conic_pulled_back(V: Tensor, conics: Tensor, v_conics: Tensor) -> Tensor:
    V = V.clone().requires_grad_()
    Q = torch.linalg.inv(torch.einsum("ikn,jkn->nij", V, V) + 0.3 * torch.eye(2, dtype=V.dtype))
    loss = (v_conics * torch.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]])).sum()
    return torch.autograd.grad(loss, V)[0]


def twist_pulled_back(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
    turn = torch.linalg.cross(x, v_x, dim=0).sum(1)
    turn = turn + torch.linalg.cross(B, v_B, dim=0).sum((1, 2))
    return torch.cat([v_x.sum(1), turn])


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_projected_covariance, projected)
    assert_graded(check_pixel_color, blended)
    assert_graded(check_conic_vjp, conic_pulled_back)
    assert_graded(check_twist_vjp, twist_pulled_back)


def test_known_mistakes_of_splatting_are_named():
    low_pass = 0.3 * torch.eye(2, dtype=torch.float64)
    verdict = check_projected_covariance(lambda *a: projected(*a) - low_pass)
    assert "add 0.3 I" in verdict.sentence

    def not_turned(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        return projected(pose[:3, :3].T @ covariance @ pose[:3, :3], mean, pose, camera)

    verdict = check_projected_covariance(not_turned)
    assert "turned camera" in verdict.sentence and "world frame" in verdict.sentence
    verdict = check_pixel_color(lambda a, c, back: blended(a.flip(0), c.flip(0), back))
    assert "sorted nearest first" in verdict.sentence
    verdict = check_pixel_color(lambda a, c, back: blended(a, c, 0 * back))
    assert "background is missing" in verdict.sentence


def test_known_mistakes_of_gradients_are_named():
    assert "sign is flipped" in check_conic_vjp(lambda *a: -conic_pulled_back(*a)).sentence
    twice_b = torch.tensor([[1.0], [2.0], [1.0]], dtype=torch.float64)
    verdict = check_conic_vjp(lambda V, Q, v: conic_pulled_back(V, Q, twice_b * v))
    assert "b is counted twice" in verdict.sentence
    verdict = check_twist_vjp(lambda x, B, v_x, v_B: twist_pulled_back(x, B, v_x, 0 * v_B))
    assert "for means and factors" in verdict.sentence
    assert "turn with the camera" in verdict.sentence
    verdict = check_twist_vjp(lambda *a: twist_pulled_back(*a).roll(3))
    assert "translation first" in verdict.sentence
