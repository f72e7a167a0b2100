"""The renderer as the paper writes it: dense, plain torch, differentiated by autograd.

It is slow (every Gaussian at every pixel) and serves two ends: to be read, and to be the truth
that the fast renderer in rasterizer.py is tested against, in both directions.
"""

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp, transform_points
from minislam.geometry.se3 import rotation_from_quaternion
from minislam.splatting.gaussians import GaussianMap
from minislam.splatting.rendering import (
    LOW_PASS_VARIANCE,
    MAX_OPACITY,
    MIN_ALPHA,
    NEAR_DEPTH,
    Rendering,
    tangent_limits,
)


def render_reference(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    background: Tensor | None = None,  # (3,) RGB; None is black
    twist: Tensor | None = None,  # (6,) left perturbation of the pose: T <- exp(twist) T
    screen_offsets: Tensor | None = None,  # (N, 2) px, added to the projected means
) -> Rendering:
    """Render colour, depth and opacity with every Gaussian evaluated at every pixel. Eq. (2)."""
    T_camera_world = T_camera_world.to(gaussians.means)
    if twist is not None:
        T_camera_world = se3_exp(twist) @ T_camera_world
    if background is None:
        background = torch.zeros(3).to(gaussians.means)

    points_camera = transform_points(T_camera_world, gaussians.means)  # (N, 3)
    in_front = (points_camera[:, 2] > NEAR_DEPTH).nonzero()[:, 0]
    front_to_back = in_front[points_camera[in_front, 2].argsort(stable=True)]
    points_camera = points_camera[front_to_back]
    depths = points_camera[:, 2]

    means2d = camera.project(points_camera)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[front_to_back]
    covariances2d = project_covariances(
        covariances(gaussians)[front_to_back], points_camera, T_camera_world, camera
    )
    alphas = gaussian_alphas(
        means2d, covariances2d, gaussians.opacities[front_to_back], camera
    )  # (N, H, W)

    transmittance_after = (1 - alphas).cumprod(0)  # (N, H, W), Gaussian n included
    transmittance_before = torch.cat([alphas.new_ones(1, *alphas.shape[1:]), transmittance_after])
    weights = alphas * transmittance_before[:-1]
    opacity = 1 - transmittance_before[-1]
    color = torch.einsum("nhw,nc->hwc", weights, gaussians.colors[front_to_back])
    color = color + transmittance_before[-1, :, :, None] * background
    depth = torch.einsum("nhw,n->hw", weights, depths)

    contribution = torch.zeros_like(gaussians.opacities.detach())
    contribution[front_to_back] = weights.detach().sum((1, 2))
    radii = torch.zeros_like(contribution)
    largest_variance = torch.linalg.eigvalsh(covariances2d.detach())[:, 1]
    radii[front_to_back] = 3 * largest_variance.sqrt()
    radii = radii * (contribution > 0)
    return Rendering(color, depth, opacity, radii, contribution)


def covariances(gaussians: GaussianMap) -> Tensor:  # (N, 3, 3) world units^2
    """Return Sigma = R diag(s)^2 R^T of each Gaussian (Sec. 3.1)."""
    rotations = rotation_from_quaternion(gaussians.quats_wxyz)
    variances = gaussians.scales**2
    return rotations @ torch.diag_embed(variances) @ rotations.transpose(-1, -2)


def project_covariances(
    covariances_world: Tensor,  # (N, 3, 3)
    points_camera: Tensor,  # (N, 3)
    T_camera_world: Tensor,  # (4, 4)
    camera: Camera,
) -> Tensor:  # (N, 2, 2) px^2
    """Return Sigma' = J W Sigma W^T J^T, plus the low-pass filter (Sec. 3.1).

    J is the Jacobian of the projection at the mean, at most VIEW_MARGIN outside the image.
    """
    z = points_camera[:, 2:]
    tangents = points_camera[:, :2] / z
    lower, upper = tangent_limits(camera)
    lower, upper = torch.tensor(lower).to(tangents), torch.tensor(upper).to(tangents)
    limited = torch.cat([torch.minimum(torch.maximum(tangents, lower), upper) * z, z], -1)
    to_pixels = camera.project_jacobian(limited) @ T_camera_world[:3, :3]  # J W, (N, 2, 3)
    projected = to_pixels @ covariances_world @ to_pixels.transpose(-1, -2)
    return projected + LOW_PASS_VARIANCE * torch.eye(2).to(projected)


def gaussian_alphas(
    means2d: Tensor,  # (N, 2) px
    covariances2d: Tensor,  # (N, 2, 2) px^2
    opacities: Tensor,  # (N,)
    camera: Camera,
) -> Tensor:  # (N, H, W)
    """Return alpha = o exp(-d^T Sigma'^-1 d / 2) of each Gaussian at each pixel. Eq. (1)."""
    pixels = camera.pixel_grid(dtype=means2d.dtype, device=means2d.device)
    offsets = pixels - means2d[:, None, None, :]  # (N, H, W, 2)
    conics = torch.linalg.inv(covariances2d)
    distances = torch.einsum("nhwi,nij,nhwj->nhw", offsets, conics, offsets)
    alphas = opacities.clamp(max=MAX_OPACITY)[:, None, None] * torch.exp(-0.5 * distances)
    return torch.where(alphas > MIN_ALPHA, alphas, torch.zeros_like(alphas))
