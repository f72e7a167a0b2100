"""Exercises of notebook 03."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from minislam.checks.grading import Case, Verdict, check_function, doubles, drawn, normals
from minislam.splatting.projection import (
    conics_from_factors2d,
    conics_from_factors2d_vjp,
    to_camera_twist_vjp,
)


def check_conic_vjp(student: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (factors2d, conics, v_conics) -> v_factors2d (2, 3, N)."""
    reference = conics_from_factors2d_vjp

    def product(
        factors: str, above: float, below: float, V: Tensor, conics: Tensor, v: Tensor
    ) -> Tensor:
        """Return -2 times a product like QGQ with V, from two parts of v_b."""
        G = torch.stack([v[0], above * v[1], below * v[1], v[2]]).view(2, 2, -1)
        matrices = {"Q": conics[[0, 1, 1, 2]].view(2, 2, -1), "G": G}
        for name in reversed(factors):
            V = torch.einsum("ijn,jkn->ikn", matrices[name], V)
        return -2 * V

    def case(V: Tensor, v_conics: Tensor, description: str) -> Case:
        return Case((V, conics_from_factors2d(V)[0], v_conics), description)

    def draw(seed: int) -> Case:
        count = 1 + seed % 4
        return case(2 * normals(seed, 2, 3, count), normals(seed, 3, count), f"N = {count}")

    V = doubles([[3.0], [1.0], [0.5]], [[-1.0], [2.0], [0.0]])
    cases = [
        case(V, doubles([1.0], [0.0], [0.0]), "a gradient of a alone"),
        case(V, doubles([0.7], [-1.2], [0.4]), "a gradient of a, b and c"),
        case(normals(7, 2, 3, 3) + V, normals(8, 3, 3), "three Gaussians"),
        *drawn(draw),
    ]
    hints = [
        (lambda *a: -reference(*a), "The sign is flipped: d(M^-1) = -M^-1 dM M^-1."),
        (lambda *a: reference(*a) / 2, "A factor 2 is missing: V appears twice in V V^T."),
        (lambda *a: product("QGQ", 1, 1, *a), "b is counted twice: each place gets v_b / 2."),
        (lambda *a: product("QGQ", 1, 0, *a), "G is symmetric: v_b / 2 above and below."),
        (lambda *a: product("QG", 0.5, 0.5, *a), "Q stands on both sides of G: Q G Q."),
        (lambda *a: product("GQ", 0.5, 0.5, *a), "Q stands on both sides of G: Q G Q."),
        (lambda V, *a: 0 * V + reference(V, *a).sum(-1, True), "Do not sum over the N Gaussians."),
        (lambda V, *a: 0 * V + reference(V, *a)[..., :1], "Each Gaussian has its own gradient."),
    ]
    return check_function(student, reference, cases, 1e-9, hints)


def check_twist_vjp(student: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (points, factors, v_points, v_factors) -> v_twist (6,) of (rho, phi)."""
    points, v_points = normals(0, 2, 3, 4)
    factors, v_factors = normals(1, 2, 3, 3, 4)

    right = to_camera_twist_vjp
    exchanged = doubles(1, 1, 1, -1, -1, -1)

    def moves_factors(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return right(x, B, v_x, v_B) + torch.cat([v_B.sum((1, 2)), v_B.new_zeros(3)])

    def draw(seed: int) -> Case:
        count = 3 - seed % 3  # 3: the axis of length 3 is no longer the only one
        values = normals(seed, 8, 3, count)
        x, B, v_x, v_B = values[0], values[1:4], values[4], values[5:]
        return Case((x, B.transpose(0, 1), v_x, v_B.transpose(0, 1)), f"N = {count}")

    cases = [
        Case((points, factors, v_points, torch.zeros_like(v_factors)), "means alone"),
        Case((points, factors, v_points, v_factors), "means and factors"),
        *drawn(draw),
    ]
    hints = [
        (
            lambda x, B, v, u: right(x, B, v, 0 * u),
            "The factors turn with the camera as well: B x v_B.",
        ),
        (lambda *a: exchanged * right(*a), "The wrong way round: v_phi = x cross v_x."),
        (lambda *a: right(*a).roll(3), "The order is (rho, phi), translation first."),
        (lambda *a: right(*a) / a[0].shape[1], "Sum over all Gaussians: no mean."),
        (lambda x, *a: right(0 * x, *a), "The means turn with the camera as well: x cross v_x."),
        (moves_factors, "A translation moves the means only: the factors have no place."),
    ]
    return check_function(student, right, cases, 1e-9, hints)


def check_picture_gradient(student: Callable[..., tuple[Tensor, Tensor]]) -> Verdict:
    """Check (gaussians (K, 9), target (H, W, 3)) -> image (H, W, 3), dL/d(gaussians) (K, 9)."""

    def reference(gaussians: Tensor, target: Tensor, fixed_light: bool = False) -> tuple:
        leaf = gaussians.detach().clone().requires_grad_()
        mean_u, mean_v, a, b, c, log_o = leaf[:, :6, None, None].unbind(1)
        rows, columns = torch.meshgrid(*map(torch.arange, target.shape[:2]), indexing="ij")
        du, dv = columns - mean_u, rows - mean_v
        alphas = torch.exp(log_o - 0.5 * (a * du**2 + 2 * b * du * dv + c * dv**2))
        light = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)])[:-1]
        light = light.detach() if fixed_light else light
        image = torch.einsum("khw,kc->hwc", light * alphas, leaf[:, 6:])
        return image.detach(), torch.autograd.grad((image - target).square().sum(), leaf)[0]

    def scaled(factor: float, columns: slice) -> Callable[..., tuple[Tensor, Tensor]]:
        scale = torch.ones(9, dtype=torch.float64)
        scale[columns] = factor
        return lambda *a: (reference(*a)[0], scale * reference(*a)[1])

    def draw(seed: int) -> Case:
        return Case((gaussians + 0.03 * normals(seed, 3, 9), target), f"three Gaussians, {seed}")

    gaussians = doubles(
        [3.2, 2.1, 0.3, 0.1, 0.4, -0.3, 0.9, 0.2, 0.1],
        [5.1, 3.4, 0.2, -0.1, 0.3, -0.7, 0.1, 0.8, 0.3],
        [4.0, 3.0, 0.1, 0.02, 0.1, -0.5, 0.4, 0.3, 1.0],
    )
    target = normals(0, 7, 9, 3).abs()
    cases = [
        Case((gaussians[:1], target), "one Gaussian"),
        Case((gaussians, target), "three Gaussians, one over the other"),
        *drawn(draw),
    ]
    all_columns, returns = slice(0, 9), ("the image", "the gradient")
    hints = [
        (scaled(-1, all_columns), "The sign is flipped: v = 2 (image - target)."),
        (scaled(0.5, all_columns), "A factor 2 is missing: L is the sum of the squares."),
        (scaled(1 / target.numel(), all_columns), "L is a sum over the pixels, not a mean."),
        (scaled(-1, slice(0, 2)), "The sign of v_mu' is flipped: d = x' - mu' falls as mu' grows."),
        (scaled(0.5, slice(3, 4)), "b stands twice in the quadratic form: v_b = -sum g du dv."),
        (partial(reference, fixed_light=True), "A Gaussian also hides what is behind it: R_{k+1}."),
    ]
    return check_function(student, reference, cases, 1e-7, hints, returns=returns)
