"""Exercises of notebooks 02 and 03."""

from functools import partial
from typing import Any
from unittest.mock import Mock, patch

import torch
from torch import Tensor

from minislam.checks.cases import CAMERA, Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera, se3_exp, transform_points
from minislam.splatting import projection
from minislam.splatting.constants import LOW_PASS_VARIANCE, NEAR_DEPTH
from minislam.splatting.reference import composite, gaussian_alphas, project_covariances


def check_projected_covariance(student: Function) -> Verdict:
    """Check (covariance_world, mean_world, T_camera_world, camera) -> Sigma' (2, 2) in px^2."""

    def reference(S: Tensor, mean: Tensor, T: Tensor, camera: Camera, flaw: str = "") -> Tensor:
        back = torch.linalg.matrix_power(T[:3, :3].T, {"world": 1, "back": 2}.get(flaw, 0))
        point = mean[None] if flaw == "point" else transform_points(T, mean[None])
        return project_covariances((back @ S @ back.T)[None], point, T, camera)[0]

    def case(x: float, turn: float, description: str, seed: int = 0) -> Case:
        factor = doubles([0.3, 0.1, 0.0], [0.0, 0.2, 0.1], [0.1, 0.0, 0.05])
        factor = factor + 0.03 * normals(seed, 3, 3)
        pose = se3_exp(doubles(0.1, -0.1, 0.2, turn, -turn, 0.5 * turn))
        return Case((factor @ factor.T, doubles(x, 0.1, 2.5), pose, CAMERA), description)

    cases = [
        case(-0.1, 0.0, "a camera that is not turned"),
        case(0.6, 0.2, "a turned camera"),
        *drawn(lambda seed: case(0.2 * (seed % 7) - 0.3, 0.15, "any camera", seed)),
    ]
    low_pass = LOW_PASS_VARIANCE * torch.eye(2).double()
    off_diagonal = LOW_PASS_VARIANCE - low_pass
    mistakes = [
        (lambda *a: reference(*a) - low_pass, "The low-pass filter is missing: add 0.3 I."),
        ("world", "Sigma is still in the world frame: turn it by W before J."),
        ("back", "This turns Sigma the wrong way: it is W Sigma W^T."),
        (lambda *a: reference(*a) + off_diagonal, "0.3 stands on the diagonal alone: 0.3 I."),
        (lambda *a: torch.linalg.inv(reference(*a)), "This is the conic, the inverse of Sigma'."),
        ("point", "J is taken at the world point: move the mean into the camera frame first."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_pixel_color(student: Function) -> Verdict:
    """Check (alphas, colors, background) -> color (3,) of one pixel, nearest Gaussian first."""

    def blended(alphas: Tensor, colors: Tensor, background: Tensor, flaw: str = "") -> Tensor:
        left = 1 - alphas.cumsum(0) if flaw == "sum" else (1 - alphas).cumprod(0)
        light = torch.cat([alphas.new_ones(1), left])  # (K + 1,)
        end = {"unattenuated": 1, "no background": 0}.get(flaw, light[-1])
        before = {"itself": light[1:], "unshaded": light[:-1] ** 0}.get(flaw, light[:-1])
        return (before * alphas ** (flaw != "opaque")) @ colors + end * background

    def case(count: int, description: str, background: Tensor, seed: int = 0) -> Case:
        values = normals(seed, 5, 4).sigmoid()[:count]
        return Case((values[:, 0], values[:, 1:], background), description)

    grey, blue = doubles(0.6, 0.6, 0.6), doubles(0.1, 0.2, 0.9)
    cases = [
        case(3, "three Gaussians on black", 0 * grey),
        case(3, "three Gaussians on grey", grey),
        case(0, "no Gaussian at all", grey),
        *drawn(lambda seed: case(1 + seed % 5, f"a list of {1 + seed % 5}, on blue", blue, seed)),
    ]
    mistakes = [
        ("no background", "The background is missing: add T_end times its colour."),
        ("itself", "T_i holds only the Gaussians in front of i, not i itself."),
        ("unattenuated", "The background shines through T_end only: multiply it."),
        ("opaque", "Each colour counts T_i times its own alpha_i."),
        ("sum", "The light that is left is a product of (1 - alpha), not 1 minus a sum."),
        ("unshaded", "T_i is missing: what stands in front takes light away."),
        (lambda a, c, b: blended(a.flip(0), c.flip(0), b), "The list is sorted nearest first."),
    ]
    return check_function(student, blended, cases, 1e-9, mistakes)


def check_rendered_image(student: Function) -> Verdict:
    """Check (means, covariances, opacities, colors, T_camera_world, camera) -> image (H, W, 3)."""
    factors, colors = normals(1, 2, 7, 3, 3)
    five = [0.1, 0, 3], [0, 0.1, 2], [-0.2, -0.1, 4], [0.3, 0, -2], [-0.3, 0.2, 2.5]
    # One too near, and one that is nearer by its depth than by its distance.
    means = doubles(*five, [0, 0, 0.04], [1.2, 0, 2.8])
    opacities = doubles(0.8, 0.6, 0.9, 0.7, 1, 0.5, 0.9)
    values = means, 0.1 * factors @ factors.mT, opacities, colors[:, 0].abs()

    def rendered(*view: Any, flaw: str = "") -> Tensor:
        means, covariances, opacities, colors, pose, camera = view
        points = transform_points(pose, means)
        nearest = {"behind": -torch.inf, "near": 0.0}.get(flaw, NEAR_DEPTH)
        kept = (points[:, 2] > nearest).nonzero()[:, 0]
        far = {"distance": points.norm(dim=-1), "world": means[:, 2]}.get(flaw, points[:, 2])
        if flaw != "unsorted":
            kept = kept[far[kept].argsort(descending=flaw == "far first")]
        wide = project_covariances(covariances[kept], points[kept], pose, camera)
        wide = wide - (flaw == "sharp") * LOW_PASS_VARIANCE * torch.eye(2, dtype=wide.dtype)
        wide = wide / 2 if flaw == "whole" else wide
        alphas = gaussian_alphas(camera.project(points[kept]), wide, opacities[kept], camera)
        alphas = alphas.clamp(max=0.99) if flaw == "alpha" else alphas
        if flaw == "added":
            return torch.einsum("nhw,nc->hwc", alphas, colors[kept])
        return composite(alphas, colors[kept], torch.zeros_like(colors[0]))[0]

    def case(count: int, pose: Tensor, description: str) -> Case:
        return Case((*(x[:count] for x in values), pose, camera), description)

    camera = Camera(18.0, 22.0, 9.3, 6.8, 21, 13)

    def draw(seed: int) -> Case:
        pose = se3_exp(0.1 * normals(seed, 6).clamp(-1, 1))  # not so far that J would be limited
        return case(5, pose, f"five Gaussians and pose {seed}")

    turned = se3_exp(doubles(0.1, -0.1, 0.2, 0.1, -0.2, 0.3))
    back = torch.diag(doubles(-1, 1, -1, 1))
    back[2, 3] = 6
    cases = [
        case(1, torch.eye(4).double(), "one Gaussian"),
        case(3, turned, "three Gaussians in any order"),
        case(5, turned, "five Gaussians, one behind the camera"),
        case(7, torch.eye(4).double(), "seven Gaussians, one nearer than 0.05 m"),
        case(5, back, "a camera that looks back"),
        *drawn(draw),
    ]
    uncapped = patch("minislam.splatting.constants.MAX_OPACITY", 1.0)(rendered)
    uncut = patch("minislam.splatting.constants.MIN_ALPHA", 0.0)(rendered)
    mistakes = [
        ("unsorted", "Sort by the depth in the camera frame: the list has no order."),
        ("world", "Sort by the depth in the camera frame, not by z in the world."),
        ("far first", "This is sorted the wrong way: the nearest Gaussian comes first."),
        ("behind", "A Gaussian behind the camera (z < 0.05) is not seen: leave it out."),
        ("near", "What is nearer than 0.05 m is not seen: leave it out."),
        ("distance", "Sort by the depth z, not by the distance."),
        (uncapped, "No opacity is more than 0.99."),
        (uncut, "Drop each alpha that is not above 1/255."),
        (partial(uncapped, flaw="alpha"), "The opacity is capped at 0.99, not alpha."),
        ("sharp", "The low-pass filter is missing: add 0.3 I to Sigma'."),
        ("whole", "The exponent is -1/2 of the squared distance."),
        ("added", "Light is used up on its way: multiply T by 1 - alpha after each Gaussian."),
    ]
    return check_function(student, rendered, cases, 1e-6, mistakes)


def check_conic_vjp(student: Function) -> Verdict:
    """Check (factors2d, conics, v_conics) -> v_factors2d (2, 3, N)."""
    reference = projection.conics_from_factors2d_vjp

    def product(factors: str, above: float, below: float, *a: Tensor) -> Tensor:
        """Return -2 times a product like QGQ with V, from two parts of v_b."""
        V, conics, v = a
        G = torch.stack([v[0], above * v[1], below * v[1], v[2]]).view(2, 2, -1)
        matrices = {"Q": conics[[0, 1, 1, 2]].view(2, 2, -1), "G": G}
        for name in reversed(factors):
            V = torch.einsum("ijn,jkn->ikn", matrices[name], V)
        return -2 * V

    def case(V: Tensor, v_conics: Tensor, description: str) -> Case:
        return Case((V, projection.conics_from_factors2d(V)[0], v_conics), description)

    def draw(seed: int) -> Case:
        values = normals(seed, 3, 3, 1 + seed % 4)
        return case(2 * values[:2], values[2], f"N = {1 + seed % 4}")

    V = doubles([[3.0], [1.0], [0.5]], [[-1.0], [2.0], [0.0]])
    cases = [
        case(V, doubles([1.0], [0.0], [0.0]), "a gradient of a alone"),
        case(V, doubles([0.7], [-1.2], [0.4]), "a gradient of a, b and c"),
        case(normals(7, 2, 3, 3) + V, normals(8, 3, 3), "three Gaussians"),
        *drawn(draw),
    ]
    mistakes = [
        (lambda *a: -reference(*a), "The sign is flipped: d(M^-1) = -M^-1 dM M^-1."),
        (lambda *a: reference(*a) / 2, "A factor 2 is missing: V appears twice in V V^T."),
        (lambda *a: product("QGQ", 1, 1, *a), "b is counted twice: each place gets v_b / 2."),
        (lambda *a: product("QGQ", 1, 0, *a), "G is symmetric: v_b / 2 above and below."),
        (lambda *a: product("QG", 0.5, 0.5, *a), "Q stands on both sides of G: Q G Q."),
        (lambda *a: product("GQ", 0.5, 0.5, *a), "Q stands on both sides of G: Q G Q."),
        (lambda V, *a: 0 * V + reference(V, *a).sum(-1, True), "Do not sum over the N Gaussians."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_twist_vjp(student: Function) -> Verdict:
    """Check (points, factors, v_points, v_factors) -> v_twist (6,) of (rho, phi)."""
    right, exchanged = projection.to_camera_twist_vjp, doubles(1, 1, 1, -1, -1, -1)

    def moves_factors(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return right(x, B, v_x, v_B) + torch.cat([v_B.sum((1, 2)), v_B.new_zeros(3)])

    def case(count: int, description: str, seed: int = 0, factor: float = 1) -> Case:
        x, *B, v_x, v_B0, v_B1, v_B2 = normals(seed, 8, 3, count)
        v_B = factor * torch.stack([v_B0, v_B1, v_B2], 1)
        return Case((x, torch.stack(B, 1), v_x, v_B), description)

    cases = [
        case(4, "means alone", factor=0),
        case(4, "means and factors"),
        # With N = 3, the axis of length 3 is no longer the only one.
        *drawn(lambda seed: case(3 - seed % 3, f"N = {3 - seed % 3}", seed)),
    ]
    turning = "The factors turn with the camera as well: B x v_B."
    mistakes = [
        (lambda x, B, v, u: right(x, B, v, 0 * u), turning),
        (lambda *a: exchanged * right(*a), "The wrong way round: v_phi = x cross v_x."),
        (lambda *a: right(*a).roll(3), "The order is (rho, phi), translation first."),
        (lambda *a: right(*a) / a[0].shape[1], "Sum over all Gaussians: no mean."),
        (lambda x, *a: right(0 * x, *a), "The means turn with the camera as well: x cross v_x."),
        (moves_factors, "A translation moves the means only: the factors have no place."),
    ]
    return check_function(student, right, cases, 1e-9, mistakes)


def check_picture_gradient(student: Function) -> Verdict:
    """Check (gaussians (K, 9), target (H, W, 3)) -> image (H, W, 3), dL/d(gaussians) (K, 9)."""

    switched_off = Mock(side_effect=RuntimeError("autograd is switched off: do it by hand"))

    def by_hand(*a: Tensor) -> Any:
        off = patch.multiple(torch.autograd, grad=switched_off, backward=switched_off)
        with torch.no_grad(), off:
            return student(*a)

    def reference(gaussians: Tensor, target: Tensor, flaw: str = "") -> tuple:
        leaf = gaussians.clone().requires_grad_()
        mean_u, mean_v, a, b, c, log_o = leaf[:, :6, None, None].unbind(1)
        rows, columns = torch.meshgrid(*map(torch.arange, target.shape[:2]), indexing="ij")
        du, dv = columns - mean_u, rows - mean_v
        alphas = torch.exp(log_o - 0.5 * (a * du**2 + 2 * b * du * dv + c * dv**2))
        light = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)])[:-1]
        light = light.detach() if flaw == "fixed light" else light
        image = torch.einsum("khw,kc->hwc", light * alphas, leaf[:, 6:])
        gradient = torch.autograd.grad((image - target).square().sum(), leaf)[0]
        gradient[:, 5] /= gaussians[:, 5].exp() if flaw == "of o" else 1
        return image.detach(), gradient

    def scaled(factor: float, columns: slice = slice(9)) -> Function:
        scale = torch.ones(9, dtype=torch.float64)
        scale[columns] = factor
        return lambda *a: (reference(*a)[0], scale * reference(*a)[1])

    def case(count: int, description: str, seed: int = 0) -> Case:
        return Case((gaussians[:count] + 0.03 * normals(seed, count, 9), target), description)

    gaussians = doubles(
        [3.2, 2.1, 0.3, 0.1, 0.4, -0.3, 0.9, 0.2, 0.1],
        [5.1, 3.4, 0.2, -0.1, 0.3, -0.7, 0.1, 0.8, 0.3],
        [4.0, 3.0, 0.1, 0.02, 0.1, -0.5, 0.4, 0.3, 1.0],
    )
    target = normals(0, 7, 9, 3).abs()
    cases = [
        case(1, "one Gaussian"),
        case(3, "three Gaussians, one over the other"),
        *drawn(lambda seed: case(3, f"three Gaussians, {seed}", seed)),
    ]
    returns = "the image", "the gradient"
    mistakes = [
        (scaled(-1), "The sign is flipped: v = 2 (image - target)."),
        (scaled(0.5), "A factor 2 is missing: L is the sum of the squares."),
        (scaled(1 / target.numel()), "L is a sum over the pixels, not a mean."),
        ("of o", "The sixth column is ln o, not o: dL/d ln o = o dL/do."),
        (scaled(-1, slice(2)), "The sign of v_mu' is flipped: d = x' - mu' falls as mu' grows."),
        (scaled(0.5, slice(3, 4)), "b stands twice in the quadratic form: v_b = -sum g du dv."),
        ("fixed light", "A Gaussian also hides what is behind it: A_{k+1}."),
    ]
    return check_function(by_hand, reference, cases, 1e-7, mistakes, returns)
