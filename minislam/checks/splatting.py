"""Exercises of notebooks 02 and 03."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks.grading import (
    CAMERA,
    Case,
    Function,
    Verdict,
    check_function,
    doubles,
    normals,
)
from minislam.geometry import Camera, se3_exp, transform_points
from minislam.splatting.constants import LOW_PASS_VARIANCE
from minislam.splatting.projection import (
    conics_from_factors2d,
    conics_from_factors2d_vjp,
    to_camera_twist_vjp,
)
from minislam.splatting.reference import project_covariances


def check_projected_covariance(
    student: Callable[[Tensor, Tensor, Tensor, Camera], Tensor],
) -> Verdict:
    """Check (covariance_world, mean_world, T_camera_world, camera) -> Sigma' (2, 2) in px^2."""

    def reference(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        point = transform_points(pose, mean[None])
        return project_covariances(covariance[None], point, pose, camera)[0]

    def unfiltered(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        low_pass = LOW_PASS_VARIANCE * torch.eye(2, dtype=covariance.dtype)
        return reference(covariance, mean, pose, camera) - low_pass

    def not_turned(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        rotation = pose[:3, :3]
        return reference(rotation.T @ covariance @ rotation, mean, pose, camera)

    def turned_back(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        twice = pose[:3, :3].T @ pose[:3, :3].T
        return reference(twice @ covariance @ twice.T, mean, pose, camera)

    def spread(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        return unfiltered(covariance, mean, pose, camera) + LOW_PASS_VARIANCE

    def in_world(covariance: Tensor, mean: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        return project_covariances(covariance[None], mean[None], pose, camera)[0]

    def case(x: float, turn: float, description: str, seed: int = 0) -> Case:
        factor = doubles([0.3, 0.1, 0.0], [0.0, 0.2, 0.1], [0.1, 0.0, 0.05])
        factor = factor + 0.03 * normals(seed, 3, 3)
        pose = se3_exp(doubles(0.1, -0.1, 0.2, turn, -turn, 0.5 * turn))
        return Case((factor @ factor.T, doubles(x, 0.1, 2.5), pose, CAMERA), description)

    def draw(seed: int) -> Case:
        x, turn = normals(seed, 2).clamp(-2, 2).tolist()
        return case(0.3 * x, 0.15 * turn, "any camera", seed)

    cases = [case(-0.1, 0.0, "a camera that is not turned"), case(0.6, 0.2, "a turned camera")]
    hints = [
        (unfiltered, "The low-pass filter is missing: add 0.3 I."),
        (not_turned, "Sigma is still in the world frame: turn it by W before J."),
        (turned_back, "This turns Sigma the wrong way: it is W Sigma W^T."),
        (spread, "0.3 stands on the diagonal alone: 0.3 I."),
        (in_world, "J is taken at the world point: move the mean into the camera frame first."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_pixel_color(student: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (alphas, colors, background) -> color (3,) of one pixel, nearest Gaussian first."""

    def blend(light: Tensor, alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return (light[:-1] * alphas) @ colors + light[-1] * background

    def transmittances(alphas: Tensor) -> Tensor:  # (K,) -> (K + 1,)
        return torch.cat([alphas.new_ones(1), (1 - alphas).cumprod(0)])

    def reference(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return blend(transmittances(alphas), alphas, colors, background)

    def without_background(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return reference(alphas, colors, torch.zeros_like(background))

    def far_first(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return reference(alphas.flip(0), colors.flip(0), background)

    def shades_itself(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        light = transmittances(alphas)
        return blend(torch.cat([light[1:], light[-1:]]), alphas, colors, background)

    def unattenuated(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return without_background(alphas, colors, background) + background

    def opaque(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        light = transmittances(alphas)
        return light[:-1] @ colors + light[-1] * background

    def additive(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        light = torch.cat([alphas.new_ones(1), 1 - alphas.cumsum(0)])
        return blend(light, alphas, colors, background)

    def unshaded(alphas: Tensor, colors: Tensor, background: Tensor) -> Tensor:
        return alphas @ colors + transmittances(alphas)[-1] * background

    def draw(seed: int) -> Case:
        values = normals(seed, 5, 4).sigmoid()[: 1 + seed % 5]
        description = f"a list of {len(values)}, on blue"
        return Case((values[:, 0], values[:, 1:], doubles(0.1, 0.2, 0.9)), description)

    colors = doubles([0.9, 0.1, 0.2], [0.3, 0.8, 0.4], [0.2, 0.5, 1.0])
    alphas = doubles(0.3, 0.6, 0.5)
    grey = doubles(0.6, 0.6, 0.6)
    cases = [
        Case((alphas, colors, torch.zeros_like(grey)), "three Gaussians on black"),
        Case((alphas, colors, grey), "three Gaussians on grey"),
        Case((alphas[:0], colors[:0], grey), "no Gaussian at all"),
    ]
    hints = [
        (without_background, "The background is missing: add T_end times its colour."),
        (far_first, "This starts with the farthest: the list is sorted nearest first."),
        (shades_itself, "T_i holds only the Gaussians in front of i, not i itself."),
        (unattenuated, "The background shines through T_end only: multiply it."),
        (opaque, "Each colour counts T_i times its own alpha_i."),
        (additive, "The light that is left is a product of (1 - alpha), not 1 minus a sum."),
        (unshaded, "T_i is missing: what stands in front takes light away."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_conic_vjp(student: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (factors2d, conics, v_conics) -> v_factors2d (2, 3, N)."""

    reference = conics_from_factors2d_vjp

    def product(factors: str, above: float, below: float) -> Function:
        """Return -2 times a product like QGQ with V, from two parts of v_b."""

        def answer(V: Tensor, conics: Tensor, v: Tensor) -> Tensor:
            G = torch.stack([v[0], above * v[1], below * v[1], v[2]]).view(2, 2, -1)
            matrices = {"Q": conics[[0, 1, 1, 2]].view(2, 2, -1), "G": G}
            for name in reversed(factors):
                V = torch.einsum("ijn,jkn->ikn", matrices[name], V)
            return -2 * V

        return answer

    def summed(V: Tensor, conics: Tensor, v: Tensor) -> Tensor:
        return reference(V, conics, v).sum(-1, keepdim=True).expand_as(V)

    def of_the_first(V: Tensor, conics: Tensor, v: Tensor) -> Tensor:
        return reference(V, conics, v)[..., :1].expand_as(V)

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
    ]
    hints = [
        (lambda *a: -reference(*a), "The sign is flipped: d(M^-1) = -M^-1 dM M^-1."),
        (lambda *a: reference(*a) / 2, "A factor 2 is missing: V appears twice in V V^T."),
        (
            product("QGQ", 1, 1),
            "b is counted twice: it stands twice in Q, so each place gets v_b / 2.",
        ),
        (product("QGQ", 1, 0), "G is symmetric: v_b / 2 stands above and below the diagonal."),
        (product("QG", 0.5, 0.5), "Q stands on both sides of G: Q G Q."),
        (product("GQ", 0.5, 0.5), "Q stands on both sides of G: Q G Q."),
        (summed, "Each Gaussian has its own gradient: do not sum over N."),
        (of_the_first, "This is the first Gaussian's gradient for all of them."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_twist_vjp(student: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]) -> Verdict:
    """Check (points, factors, v_points, v_factors) -> v_twist (6,) of (rho, phi)."""
    points, v_points = normals(0, 2, 3, 4)
    factors, v_factors = normals(1, 2, 3, 3, 4)

    def points_only(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return to_camera_twist_vjp(x, B, v_x, torch.zeros_like(v_B))

    def swapped(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return doubles(1, 1, 1, -1, -1, -1) * to_camera_twist_vjp(x, B, v_x, v_B)

    def rotation_first(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return to_camera_twist_vjp(x, B, v_x, v_B).roll(3)

    def factors_only(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        return to_camera_twist_vjp(0 * x, B, v_x, v_B)

    def moves_factors(x: Tensor, B: Tensor, v_x: Tensor, v_B: Tensor) -> Tensor:
        slide = torch.cat([v_B.sum((1, 2)), v_B.new_zeros(3)])
        return to_camera_twist_vjp(x, B, v_x, v_B) + slide

    def draw(seed: int) -> Case:
        count = 3 - seed % 3  # 3: the axis of length 3 is no longer the only one
        values = normals(seed, 8, 3, count)
        x, B, v_x, v_B = values[0], values[1:4], values[4], values[5:]
        return Case((x, B.transpose(0, 1), v_x, v_B.transpose(0, 1)), f"N = {count}")

    cases = [
        Case((points, factors, v_points, torch.zeros_like(v_factors)), "means alone"),
        Case((points, factors, v_points, v_factors), "means and factors"),
    ]
    hints = [
        (points_only, "The factors turn with the camera as well: add B x v_B, column by column."),
        (swapped, "The cross product is the wrong way round: v_phi = x cross v_x."),
        (rotation_first, "The order is (rho, phi), translation first."),
        (lambda *a: to_camera_twist_vjp(*a) / a[0].shape[1], "Sum over all Gaussians: no mean."),
        (factors_only, "The means turn with the camera as well: x cross v_x."),
        (moves_factors, "A translation moves the means only: the factors have no place."),
    ]
    return check_function(student, to_camera_twist_vjp, cases, 1e-9, hints, draw)
