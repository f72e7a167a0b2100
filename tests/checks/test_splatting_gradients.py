"""The check of the exercise of notebook 03 that builds: right answers pass, wrong ones do not."""

from functools import partial

import torch
from torch import Tensor

from minislam.checks import check_picture_gradient
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


def gradient_by_autograd(gaussians: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    def loss(values: Tensor) -> tuple[Tensor, Tensor]:
        rows, columns = torch.meshgrid(*map(torch.arange, target.shape[:2]), indexing="ij")
        image = torch.zeros_like(target)
        for mean_u, mean_v, a, b, c, log_o, *color in values.flip(0):  # from the back
            du, dv = columns - mean_u, rows - mean_v
            alpha = torch.exp(log_o - 0.5 * (a * du**2 + 2 * b * du * dv + c * dv**2))
            image = alpha[..., None] * torch.stack(color) + (1 - alpha[..., None]) * image
        return ((image - target) ** 2).sum(), image

    return torch.func.grad(loss, has_aux=True)(gaussians)[::-1]


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
    right = {"by hand": picture_gradient, "autograd": gradient_by_autograd}
    assert_variants(check_picture_gradient, right, wrong)
    assert "not o" in check_picture_gradient(by_opacity).hint
