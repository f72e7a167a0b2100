"""The visible Gaussians: all steps of projection.py in a row, nearest first, and back."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting import constants, projection
from minislam.splatting.compositing import moments_vjp
from minislam.splatting.constants import MAX_OPACITY, MIN_ALPHA
from minislam.splatting.covariance import covariance_factors, covariance_factors_vjp
from minislam.splatting.tiles import stable_argsort

# px. The determinant of Sigma' grows with the fourth power of it, and float32 ends at 1e38.
_MAX_RADIUS = 1e8


class VisibleGaussians(NamedTuple):
    """The visible Gaussians, nearest first, in every form that the backward needs."""

    rows: Tensor  # (V,) int64, row in the map
    quats: Tensor  # (4, V)
    scales: Tensor  # (3, V)
    opacities: Tensor  # (V,) at most MAX_OPACITY
    points_camera: Tensor  # (3, V)
    camera_factors: Tensor  # (3, 3, V)
    factors2d: Tensor  # (2, 3, V)
    means2d: Tensor  # (2, V)
    conics: Tensor  # (3, V) a, b, c of Q = [[a, b], [b, c]]
    covariances2d: Tensor  # (3, V) xx, xy, yy of Sigma'


class VisibleGradients(NamedTuple):
    """dL/d of the visible Gaussians' parameters, in the order of `VisibleGaussians.rows`."""

    means: Tensor  # (3, V)
    quats: Tensor | None  # (4, V)
    scales: Tensor | None  # (3, V)
    opacities: Tensor  # (V,)
    twist: Tensor  # (6,) at the rendered pose
    means2d: Tensor  # (2, V)


def project_gaussians(
    means: Tensor,  # (N, 3)
    quats: Tensor,  # (N, 4)
    scales: Tensor,  # (N, 3)
    opacities: Tensor,  # (N,)
    screen_offsets: Tensor | None,  # (N, 2) px, small: what is visible is decided without them
    T_camera_world: Tensor,  # (4, 4)
    camera: Camera,
) -> VisibleGaussians:
    """Project what can be seen, in order of depth. Slow twin: reference.project_gaussians."""
    rows = _visible_front_to_back(means, scales, opacities, T_camera_world, camera)
    # index_select throughout: it is several times faster than indexing with a tensor.
    means, quats, scales = (x.index_select(0, rows).T.contiguous() for x in (means, quats, scales))
    # Capped per Gaussian, not per pixel: the profile stays smooth, and alpha <= o is safe as well.
    opacities = opacities[rows].clamp(max=MAX_OPACITY)
    factors = covariance_factors(quats, scales)
    points_camera, camera_factors = projection.to_camera(means, factors, T_camera_world)
    means2d = projection.project_means(points_camera, camera)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[rows].T
    factors2d = projection.project_factors(points_camera, camera_factors, camera)
    conics, covariances2d = projection.conics_from_factors2d(factors2d)
    return VisibleGaussians(
        rows, quats, scales, opacities, points_camera, camera_factors,
        factors2d, means2d, conics, covariances2d,
    )  # fmt: skip


def project_gaussians_vjp(
    visible: VisibleGaussians,
    moments: Tensor,  # (6, V) of dL/d ln alpha about the mean, see `moments_vjp`
    v_depths: Tensor,  # (V,)  dL/dz through the depth image
    T_camera_world: Tensor,  # (4, 4)
    camera: Camera,
    needs_shape: bool,  # False if only the gradient of the pose is needed
) -> VisibleGradients:
    """Pull gradients in the image back to the Gaussians and to the camera pose."""
    g = visible
    v_log_opacities, v_means2d, v_conics = moments_vjp(g.conics, moments)
    v_opacities = v_log_opacities / g.opacities * (g.opacities < MAX_OPACITY)

    v_factors2d = projection.conics_from_factors2d_vjp(g.factors2d, g.conics, v_conics)
    points, factors = g.points_camera, g.camera_factors
    v_points, v_camera_factors = projection.project_factors_vjp(
        points, factors, g.factors2d, camera, v_factors2d
    )
    v_points += projection.project_means_vjp(points, camera, v_means2d)
    v_points[2] += v_depths

    v_twist = projection.to_camera_twist_vjp(points, factors, v_points, v_camera_factors)
    v_means, v_factors = projection.to_camera_vjp(T_camera_world, v_points, v_camera_factors)
    v_quats = v_scales = None
    if needs_shape:
        v_quats, v_scales = covariance_factors_vjp(g.quats, g.scales, v_factors)
    return VisibleGradients(v_means, v_quats, v_scales, v_opacities, v_twist, v_means2d)


def _visible_front_to_back(
    means: Tensor, scales: Tensor, opacities: Tensor, T_camera_world: Tensor, camera: Camera
) -> Tensor:  # (V,) int64
    """Return the rows that may be visible, nearest first; equal depths stay in map order."""
    x, y, z = torch.addmm(T_camera_world[:3, 3:], T_camera_world[:3, :3], means.T)
    in_front = z > constants.NEAR_DEPTH
    inverse_z = 1 / torch.where(in_front, z, 1)  # what is dropped must not divide by zero
    u, v = camera.fx * x * inverse_z + camera.cx, camera.fy * y * inverse_z + camera.cy
    radius = _largest_radius(scales, inverse_z, camera)
    near_u = (u + radius >= 0) & (u - radius <= camera.width - 1)
    near_v = (v + radius >= 0) & (v - radius <= camera.height - 1)
    # A diverged scale would overflow to NaN, and one NaN spoils the pose gradient.
    visible = in_front & near_u & near_v & (radius < _MAX_RADIUS) & (opacities > MIN_ALPHA)
    rows = visible.nonzero()[:, 0]
    z = z.index_select(0, rows)
    if z.dtype != torch.float32:
        return rows.index_select(0, z.argsort(stable=True))
    return rows.index_select(0, stable_argsort(z.view(torch.int32)))  # the bits are in order, too


def _largest_radius(scales: Tensor, inverse_z: Tensor, camera: Camera) -> Tensor:  # (N,) px
    """Bound the radius of the support before anything is projected."""
    # |J| <= f/z sqrt(1 + h_x^2 + h_y^2) for tangents h within their limits, and the support ends
    # at sqrt(2 ln(MAX_OPACITY / MIN_ALPHA)) = 3.33 standard deviations.
    lower, upper = constants.tangent_limits(camera)
    h_x, h_y = (max(-low, high) for low, high in zip(lower, upper, strict=True))
    stretch = max(camera.fx, camera.fy) * math.sqrt(1 + h_x**2 + h_y**2)
    largest_scale = torch.maximum(torch.maximum(scales[:, 0], scales[:, 1]), scales[:, 2])
    variance = (largest_scale * inverse_z * stretch) ** 2 + constants.LOW_PASS_VARIANCE
    return (2 * math.log(MAX_OPACITY / MIN_ALPHA) * variance).sqrt() + 1  # 1 px for rounding
