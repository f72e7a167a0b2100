"""The checks of notebooks 02 and 03: right answers pass, known mistakes are named."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from minislam.checks import (
    PASSED,
    check_conic_vjp,
    check_pixel_color,
    check_projected_covariance,
    check_rendered_image,
    check_twist_vjp,
)
from minislam.geometry import Camera
from tests.helpers import assert_graded, assert_variants


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


def rendered(means, covariances, opacities, colors, pose, camera, flaw: str = "") -> Tensor:
    points = means @ pose[:3, :3].T + pose[:3, 3]
    far = {"distance": points.norm(dim=1), "world": means[:, 2]}.get(flaw, points[:, 2])
    order = far.argsort()
    order = order.sort().values if flaw == "unsorted" else order
    image = torch.zeros(camera.height, camera.width, 3, dtype=means.dtype)
    light = torch.ones(camera.height, camera.width, 1, dtype=means.dtype)
    for n in order.flip(0) if flaw == "far first" else order:
        if points[n, 2] < (0.0 if flaw == "near" else 0.05) and flaw != "behind":
            continue
        wide = projected(covariances[n], means[n], pose, camera)
        wide = wide - 0.3 * torch.eye(2, dtype=wide.dtype) if flaw == "sharp" else wide
        offsets = camera.pixel_grid(dtype=wide.dtype) - camera.project(points[n])
        offsets = offsets.flip(-1) if flaw == "exchanged" else offsets
        distances = ((offsets @ wide.inverse()) * offsets).sum(-1, keepdim=True)
        alpha = opacities[n].clamp_max(1.0 if flaw in ("opaque", "of alpha") else 0.99)
        alpha = alpha * torch.exp(-distances * (1.0 if flaw == "whole" else 0.5))
        alpha = alpha.clamp_max(0.99) if flaw == "of alpha" else alpha
        alpha = alpha if flaw == "uncut" else torch.where(alpha > 1 / 255, alpha, 0)
        image = image + light * alpha * colors[n]
        light = light if flaw == "added" else light * (1 - alpha)
    return image


def rendered_by_pixels(means, covariances, opacities, colors, pose, camera) -> np.ndarray:
    points = (pose[:3, :3] @ means.T).T + pose[:3, 3]
    seen = [n for n in np.argsort(points[:, 2].numpy()) if points[n, 2] > 0.05]
    conics = [
        np.linalg.inv(projected(covariances[n], means[n], pose, camera).numpy()) for n in seen
    ]
    centres = [camera.project(points[n]).numpy() for n in seen]
    image = np.zeros((camera.height, camera.width, 3))
    for v, u in np.ndindex(image.shape[:2]):
        for n, Q, centre in reversed(list(zip(seen, conics, centres, strict=True))):
            d = np.array([u, v]) - centre
            alpha = min(0.99, float(opacities[n])) * np.exp(-0.5 * d @ Q @ d)
            if alpha > 1 / 255:
                image[v, u] = alpha * colors[n].numpy() + (1 - alpha) * image[v, u]
    return image


@pytest.mark.ex02_3
def test_a_rendered_image_is_told_from_a_wrong_one():
    wrong = {
        "the list has no order": partial(rendered, flaw="unsorted"),
        "the wrong way": partial(rendered, flaw="far first"),
        "behind the camera": partial(rendered, flaw="behind"),
        "add 0.3 I": partial(rendered, flaw="sharp"),
        "exponent is -1/2": partial(rendered, flaw="whole"),
        "multiply T": partial(rendered, flaw="added"),
        "no cap": partial(rendered, flaw="opaque"),
        "u and v": partial(rendered, flaw="exchanged"),
        "nearer than 0.05 m": partial(rendered, flaw="near"),
        "by distance": partial(rendered, flaw="distance"),
        "by z in the world": partial(rendered, flaw="world"),
        "alpha is capped": partial(rendered, flaw="of alpha"),
        "above 1/255": partial(rendered, flaw="uncut"),
    }
    assert_variants(check_rendered_image, {"one": rendered, "other": rendered_by_pixels}, wrong)
    verdict = check_rendered_image(wrong["by z in the world"])
    assert "not by z in the world" in verdict.sentence


@pytest.mark.ex02_3
@pytest.mark.parametrize("seed", [106, 125, 132])
def test_no_drawn_pose_is_so_far_that_the_package_limits_the_jacobian(seed: int, monkeypatch):
    monkeypatch.setenv("MINISLAM_SEED", str(seed))
    assert check_rendered_image(rendered).status == PASSED
