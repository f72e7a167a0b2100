"""The graders: right answers pass, known mistakes are named, an empty answer is "not yet"."""

import pytest
import torch
from torch import Tensor

from minislam.checks import (
    NOT_YET,
    PASSED,
    WRONG,
    Case,
    check_conic_vjp,
    check_function,
    check_mapping_weight,
    check_pixel_color,
    check_projected_covariance,
    check_reproject,
    check_resized_intrinsics,
    check_schur_step,
    check_target_jacobian,
    check_twist_vjp,
)
from minislam.geometry import Camera, se3_inverse, transform_points
from tests.helpers import unfinished


def resized(camera: Camera, width: int, height: int) -> Tensor:
    su, sv = width / camera.width, height / camera.height
    cx, cy = (camera.cx + 0.5) * su - 0.5, (camera.cy + 0.5) * sv - 0.5
    return torch.tensor([camera.fx * su, camera.fy * sv, cx, cy], dtype=torch.float64)


def reprojected(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
    return camera.project(transform_points(pose, camera.backproject(pixels, 1 / disparities)))


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


def weight_of(beta: Tensor) -> Tensor:
    weight = 0.5 / (1.6315789 * (beta.clamp_min(0.1) - 0.099) + 0.1) ** 2
    return torch.where(weight < 0.1, 0.0, weight)


def jacobian_of_target(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
    def seen(points: Tensor) -> Tensor:
        return camera.project(points)

    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        moved = disparities[:, None] * axis
        columns.append(torch.func.jvp(seen, (points,), (moved,))[1])
    for axis in torch.eye(3, dtype=torch.float64):
        moved = torch.linalg.cross(axis.expand_as(points), points)
        columns.append(torch.func.jvp(seen, (points,), (moved,))[1])
    return torch.stack(columns, -1)


def step_of_all(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    matrix = torch.cat([torch.cat([H, E], 1), torch.cat([E.T, C.diag()], 1)])
    return torch.linalg.solve(matrix, torch.cat([g, s])).split((len(g), len(s)))


CHECKS = [
    (check_mapping_weight, weight_of),
    (check_resized_intrinsics, resized),
    (check_reproject, reprojected),
    (check_projected_covariance, projected),
    (check_pixel_color, blended),
    (check_conic_vjp, conic_pulled_back),
    (check_twist_vjp, twist_pulled_back),
    (check_target_jacobian, jacobian_of_target),
    (check_schur_step, step_of_all),
]


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_solution_passes_and_an_empty_one_is_not_yet(check, solution):
    assert check(solution).status == PASSED
    assert check(unfinished).status == NOT_YET
    assert check(lambda *arguments: None).status == NOT_YET


def scaled(factor: float, answer: Tensor | tuple[Tensor, ...]) -> Tensor | tuple[Tensor, ...]:
    if isinstance(answer, tuple):
        return tuple(factor * part for part in answer)
    return factor * answer


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_flipped_sign_or_one_percent_is_wrong_and_the_sentence_has_the_number(check, solution):
    for factor in (-1, 1.01):
        verdict = check(lambda *a, factor=factor: scaled(factor, solution(*a)))
        assert verdict.status == WRONG and ", expected " in verdict.sentence
        assert repr(verdict).startswith("Wrong: for ")


def test_known_mistakes_are_named():
    verdict = check_resized_intrinsics(lambda c, w, h: torch.tensor(
        [c.fx * w / c.width, c.fy * h / c.height, c.cx * w / c.width, c.cy * h / c.height]
    ))  # fmt: skip
    assert "the image starts at -0.5" in verdict.sentence
    assert "for twice the size element [2] is 82.6, expected 83.1" in verdict.sentence
    inverse = check_reproject(lambda p, d, c, pose: reprojected(p, d, c, se3_inverse(pose)))
    assert "inverse motion" in inverse.sentence
    depth = check_reproject(lambda p, d, c, pose: reprojected(p, 1 / d, c, pose))
    assert "depth = 1 / disparity" in depth.sentence


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


def test_known_mistakes_of_bundle_adjustment_are_named():
    first_three = torch.tensor([1.0, 1, 1, -1, -1, -1], dtype=torch.float64)
    verdict = check_target_jacobian(lambda *a: first_three * jacobian_of_target(*a))
    assert "wrong way round" in verdict.sentence
    verdict = check_target_jacobian(lambda X, d, K: jacobian_of_target(X, torch.ones_like(d), K))
    assert "for any disparities" in verdict.sentence and "d rho" in verdict.sentence
    assert "residual" in check_target_jacobian(lambda *a: -jacobian_of_target(*a)).sentence

    def alone(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H, g)
        return xi, (s - E.T @ xi) / C

    assert "subtract E C^-1 E^T" in check_schur_step(alone).sentence
    verdict = check_schur_step(lambda H, E, C, g, s: (step_of_all(H, E, C, g, s)[0], s / C))
    assert "follow the poses" in verdict.sentence
    assert check_schur_step(lambda *a: (a[3], None)).status == WRONG


def test_shapes_types_nan_and_exceptions_are_answered_in_words():
    cases = [Case((torch.ones(3),), "three ones")]

    def check(student) -> str:
        return check_function(student, lambda x: x, cases).sentence

    assert "the shape is (2,), expected (3,)" in check(lambda x: x[:2])
    assert "returns a str" in check(lambda x: "three")
    assert "element [0] is nan, expected 1" in check(lambda x: x * float("nan"))
    assert "stops with ZeroDivisionError" in check(lambda x: 1 / 0)
