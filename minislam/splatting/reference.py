"""The renderer as the paper writes it: dense, plain torch, differentiated by autograd.

It evaluates every Gaussian at every pixel and is therefore slow. Read it first. The fast renderer
is tested against its values and gradients; what both compute has the same name in both.
"""

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp, transform_points
from minislam.geometry.se3 import rotation_from_quaternion
from minislam.splatting import constants
from minislam.splatting.constants import Rendering
from minislam.splatting.gaussians import GaussianMap


def render_reference(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    background: Tensor | None = None,  # (3,) RGB; None is black
    twist: Tensor | None = None,  # (6,) left perturbation of the pose: T <- exp(twist) T
    screen_offsets: Tensor | None = None,  # (N, 2) px, added to the projected means
) -> Rendering:
    """Render colour, depth and opacity of a map from a camera pose. Fast twin: renderer.render."""
    T_camera_world = T_camera_world.to(gaussians.means)
    if twist is not None:
        T_camera_world = se3_exp(twist) @ T_camera_world
    behind = gaussians.means.new_zeros(4)  # channels of the background: colour, and depth 0
    if background is not None:
        behind = torch.cat([background, behind[3:]])

    projected = project_gaussians(gaussians, camera, T_camera_world, screen_offsets)
    rows, points_camera, means2d, covariances2d = projected
    alphas = gaussian_alphas(means2d, covariances2d, gaussians.opacities[rows], camera)
    channels = torch.cat([gaussians.colors[rows], points_camera[:, 2:]], 1)
    image, transmittance, weights = composite(alphas, channels, behind)

    weight_sums = torch.zeros_like(gaussians.opacities.detach())
    weight_sums[rows] = weights.detach().sum((1, 2))
    return Rendering(image[..., :3], image[..., 3], 1 - transmittance, weight_sums)


def project_gaussians(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    screen_offsets: Tensor | None,  # (N, 2) px
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # (V,) int64, (V, 3), (V, 2) px, (V, 2, 2) px^2
    """Return rows, points, means and covariances of what is in front, nearest first (Sec. 3.1).

    Fast twin: visible.project_gaussians, which also drops what lies outside the image.
    """
    points_camera = transform_points(T_camera_world, gaussians.means)
    in_front = (points_camera[:, 2] > constants.NEAR_DEPTH).nonzero()[:, 0]
    rows = in_front[points_camera[in_front, 2].argsort(stable=True)]
    points_camera = points_camera[rows]
    means2d = camera.project(points_camera)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[rows]
    of_rows = covariances(gaussians)[rows]
    covariances2d = project_covariances(of_rows, points_camera, T_camera_world, camera)
    return rows, points_camera, means2d, covariances2d


def covariances(gaussians: GaussianMap) -> Tensor:  # (N, 3, 3) world units^2
    """Return Sigma = R diag(s)^2 R^T (Sec. 3.1). Fast twin: covariance.covariance_factors, L."""
    rotations = rotation_from_quaternion(gaussians.quats_wxyz)
    return rotations @ torch.diag_embed(gaussians.scales**2) @ rotations.transpose(-1, -2)


def project_covariances(
    covariances_world: Tensor,  # (N, 3, 3)
    points_camera: Tensor,  # (N, 3)
    T_camera_world: Tensor,  # (4, 4)
    camera: Camera,
) -> Tensor:  # (N, 2, 2) px^2
    """Return Sigma' = J W Sigma W^T J^T + 0.3 I, low-pass filter included (Sec. 3.1).

    W is the rotation of T_camera_world, the inverse of the paper's R. J is the Jacobian of the
    projection at the mean, at most VIEW_MARGIN outside the image.
    Fast twin: projection.project_factors, the V of Sigma' = V V^T + 0.3 I.
    """
    z = points_camera[:, 2:]
    tangents = points_camera[:, :2] / z
    lower, upper = (tangents.new_tensor(limit) for limit in constants.tangent_limits(camera))
    limited = torch.cat([torch.minimum(torch.maximum(tangents, lower), upper) * z, z], -1)
    to_pixels = camera.project_jacobian(limited) @ T_camera_world[:3, :3]  # J W, (N, 2, 3)
    projected = to_pixels @ covariances_world @ to_pixels.transpose(-1, -2)
    return projected + constants.LOW_PASS_VARIANCE * torch.eye(2, dtype=z.dtype, device=z.device)


def gaussian_alphas(
    means2d: Tensor,  # (N, 2) px
    covariances2d: Tensor,  # (N, 2, 2) px^2
    opacities: Tensor,  # (N,)
    camera: Camera,
) -> Tensor:  # (N, H, W)
    """Return alpha = o exp(-d^T Sigma'^-1 d / 2) of each Gaussian at each pixel, d from its mean.

    Fast twin: compositing.log_alpha_coefficients. Eq. (1).
    """
    pixels = camera.pixel_grid(dtype=means2d.dtype, device=means2d.device)
    offsets = pixels - means2d[:, None, None, :]  # (N, H, W, 2)
    conics = torch.linalg.inv(covariances2d)
    distances = torch.einsum("nhwi,nij,nhwj->nhw", offsets, conics, offsets)
    capped = opacities.clamp(max=constants.MAX_OPACITY)
    alphas = capped[:, None, None] * torch.exp(-0.5 * distances)
    return torch.where(alphas > constants.MIN_ALPHA, alphas, 0)


def composite(
    alphas: Tensor,  # (N, H, W), nearest Gaussian first
    channels: Tensor,  # (N, 4) red, green, blue and z
    background: Tensor,  # (4,)
) -> tuple[Tensor, Tensor, Tensor]:  # (H, W, 4), (H, W), (N, H, W)
    """Return the image sum_n w_n f_n + T_N f_background, T_N, and the blending weights w_n.

    w_n = T_n alpha_n, where T_n = prod over m < n of (1 - alpha_m) is the transmittance in front
    of Gaussian n. Fast twin: compositing.composite. Eq. (2).
    """
    transmittances = torch.cat([alphas.new_ones(1, *alphas.shape[1:]), (1 - alphas).cumprod(0)])
    weights = transmittances[:-1] * alphas
    image = torch.einsum("nhw,nc->hwc", weights, channels)
    return image + transmittances[-1, :, :, None] * background, transmittances[-1], weights
