"""The check of the exercise of notebook 03 that builds: right answers pass, wrong ones do not."""

from functools import partial

import pytest
import torch
from torch import Tensor

from minislam.checks import WRONG, check_picture_gradient
from minislam.checks.cases import normals
from tests.helpers import assert_variants


def picture_gradient(gaussians: Tensor, target: Tensor, flaw: str = "") -> tuple[Tensor, Tensor]:
    rows, columns = torch.meshgrid(*map(torch.arange, target.shape[:2]), indexing="ij")
    layers, image, light = [], torch.zeros_like(target), torch.ones_like(target[..., 0])
    for mean_u, mean_v, a, b, c, log_o, *color in gaussians:
        d = torch.stack([columns - mean_u, rows - mean_v])
        distance = a * d[0] ** 2 + 2 * b * d[0] * d[1] + c * d[1] ** 2
        alpha, color = torch.exp(log_o - 0.5 * distance), torch.stack(color)
        layers.append((d, torch.tensor([[a, b], [b, c]]).to(d), alpha, color, light))
        image, light = image + (light * alpha)[..., None] * color, light * (1 - alpha)
    v, behind, gradient = 2 * (image - target), torch.zeros_like(light), []
    for (du, dv), Q, alpha, color, light in reversed(layers):
        here = alpha * (v @ color) + (1 - alpha) * behind
        g = light * (alpha * (v @ color) if flaw == "fixed" else here - behind)
        g = light * (1 - alpha) * (here - behind) if flaw == "own shade" else g
        behind = here
        v_mean = Q @ torch.stack([(g * du).sum(), (g * dv).sum()])
        v_conic = [-0.5 * (g * du**2).sum(), -(g * du * dv).sum(), -0.5 * (g * dv**2).sum()]
        v_color = torch.einsum("hw,hwc->c", light * alpha, v)
        gradient.append(torch.cat([v_mean, torch.stack([*v_conic, g.sum()]), v_color]))
    return image, torch.stack(gradient[::-1])


def squared_error(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    rows, columns = torch.meshgrid(*map(torch.arange, target.shape[:2]), indexing="ij")
    image = torch.zeros_like(target)
    for mean_u, mean_v, a, b, c, log_o, *color in gaussians.flip(0):  # from the back
        du, dv = columns - mean_u, rows - mean_v
        alpha = torch.exp(log_o - 0.5 * (a * du**2 + 2 * b * du * dv + c * dv**2))
        image = alpha[..., None] * torch.stack(color) + (1 - alpha[..., None]) * image
    return ((image - target) ** 2).sum(), image


def gradient_by_complex_steps(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    steps = 1e-30j * torch.eye(gaussians.numel()).view(-1, *gaussians.shape)
    slopes = [squared_error(gaussians + step, target)[0].imag / 1e-30 for step in steps]
    return squared_error(gaussians, target)[1], torch.stack(slopes).view_as(gaussians)


def backward(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor | None]:
    leaf = gaussians.clone().requires_grad_()
    loss, image = squared_error(leaf, target)
    loss.backward()
    return image, leaf.grad


def backward_again_on(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor | None]:
    with torch.enable_grad():
        return backward(gaussians, target)


def grad(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    leaf = gaussians.clone().requires_grad_()
    loss, image = squared_error(leaf, target)
    return image, torch.autograd.grad(loss, leaf)[0]


def grad_of_a_function(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    return torch.func.grad(squared_error, has_aux=True)(gaussians, target)[::-1]


def test_the_gradient_of_a_picture_is_told_from_a_wrong_one():
    def scaled(factor: float, *columns: int):
        scale = torch.ones(9, dtype=torch.float64)
        scale[list(columns)] = factor
        return lambda *a: (picture_gradient(*a)[0], scale * picture_gradient(*a)[1])

    def by_opacity(gaussians: Tensor, target: Tensor):
        image, gradient = picture_gradient(gaussians, target)
        return image, torch.cat(
            [gradient[:, :5], gradient[:, 5:6] / gaussians[:, 5:6].exp(), gradient[:, 6:]], 1
        )

    wrong = {
        "sign is flipped": scaled(-1, *range(9)),
        "by o, not by ln o": by_opacity,
        "factor 2": scaled(0.5, *range(9)),
        "not a mean": scaled(1 / 189, *range(9)),
        "falls as mu' grows": scaled(-1, 0, 1),
        "b stands twice": scaled(0.5, 3),
        "hides what is behind it": partial(picture_gradient, flaw="fixed"),
        "shades itself": partial(picture_gradient, flaw="own shade"),
        "reversed": lambda g, target: picture_gradient(g.flip(0), target),
    }
    right = {"by hand": picture_gradient, "complex steps": gradient_by_complex_steps}
    assert_variants(check_picture_gradient, right, wrong)
    assert "not o" in check_picture_gradient(by_opacity).hint


@pytest.mark.ex03_3
@pytest.mark.parametrize("answer", [backward, backward_again_on, grad, grad_of_a_function])
def test_the_gradient_of_a_picture_is_not_left_to_autograd(answer):
    gaussians, target = normals(1, 2, 9).abs(), normals(2, 4, 5, 3)
    right, found = picture_gradient(gaussians, target), answer(gaussians, target)
    assert all(torch.allclose(a, b) for a, b in zip(right, found, strict=True))
    verdict = check_picture_gradient(answer)
    assert verdict.status == WRONG and "autograd is switched off" in verdict.sentence
