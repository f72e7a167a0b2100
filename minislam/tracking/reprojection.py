"""Where a cell of one keyframe is seen in another, and how that position moves.

A cell with ray rho = K^-1 (u, v, 1) and disparity d is the point rho / d. In the target camera,
multiplied by d (which no projection notices),

    X = R rho + d t,    T_target_source = (R, t),

so a disparity of zero, a point at infinity, needs no special case. X_z is the ratio of the two
depths.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_inverse

# A point four times closer to the target than to the source is seen at a scale where no flow
# is reliable, and its derivatives explode. [-], as in DROID-SLAM.
MIN_DEPTH_RATIO = 0.25


@dataclass(frozen=True)
class Linearisation:
    """Reprojections of E edges with N cells each, with derivatives.

    The source pose needs no derivative of its own: T_target_source = T_t T_s^-1 turns a step
    xi_s of the source into the step -Ad(T_target_source) xi_s of the target, so
    J_source = -J_target Ad(T_target_source), with one 6x6 matrix for all cells of an edge.
    """

    positions: Tensor  # (E, 2, N) px
    valid: Tensor  # (E, N) bool: the depth ratio is large enough
    J_target: Tensor  # (E, 6, 2, N) px per unit of xi_target
    J_disparity: Tensor  # (E, 2, N) px per unit of the source's disparity


def relative_transforms(
    T_camera_world: Tensor,  # (K, 4, 4)
    edges_source: Tensor,  # (E,) int64
    edges_target: Tensor,  # (E,) int64
) -> Tensor:  # (E, 4, 4)
    """Return T_target_source of every edge."""
    return T_camera_world[edges_target] @ se3_inverse(T_camera_world[edges_source])


def scaled_points(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N) of the source cells
    rays: Tensor,  # (N, 3) of the source cells, z = 1
) -> Tensor:  # (E, 3, N)
    """Return X = R rho + d t for every cell of every edge."""
    rotated = T_target_source[:, :3, :3] @ rays.T
    return rotated + T_target_source[:, :3, 3:] * disparities[:, None]


def reproject(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> tuple[Tensor, Tensor]:  # (E, 2, N) px, (E, N) bool
    """Return the position of every source cell in the target image, and whether it is valid."""
    x, y, z = scaled_points(T_target_source, disparities, rays).unbind(1)
    valid = z >= MIN_DEPTH_RATIO
    inverse_z = torch.where(valid, z, torch.ones_like(z)).reciprocal()
    u = camera.fx * x * inverse_z + camera.cx
    v = camera.fy * y * inverse_z + camera.cy
    return torch.stack([u, v], 1), valid


def lengths(vectors: Tensor) -> Tensor:  # (E, 2, N) px -> (E, N) px
    """Return how long image vectors are; norm(dim=1) takes three hundred times as long here."""
    return torch.hypot(vectors[:, 0], vectors[:, 1])


def mean_parallax(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> Tensor:  # (E,) px
    """Return how far the translation alone moves the cells of each edge in the image, on average.

    It is the difference between the flow and the flow of a camera that only turned.
    """
    turned, still_seen = reproject(T_target_source, torch.zeros_like(disparities), rays, camera)
    positions, valid = reproject(T_target_source, disparities, rays, camera)
    both = (valid & still_seen).to(positions.dtype)
    shift = lengths(positions - turned)
    return (shift * both).sum(1) / both.sum(1).clamp_min(1)


def reproject_with_jacobians(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> Linearisation:
    """Return the reprojection with its derivatives (notebook 05 derives them).

    A step of the target's pose moves the point in the target frame, whose ray is X / X_z and
    whose inverse depth is d / X_z: J_target is `Camera.twist_jacobian` there. A larger d moves X
    along t.
    """
    x, y, z = scaled_points(T_target_source, disparities, rays).unbind(1)
    valid = z >= MIN_DEPTH_RATIO
    # Invalid points get zero weight from the caller; one keeps their numbers finite.
    inverse_z = torch.where(valid, z, torch.ones_like(z)).reciprocal()
    ray_x, ray_y = x * inverse_z, y * inverse_z
    J_target = camera.twist_jacobian(ray_x, ray_y, disparities * inverse_z)
    tx, ty, tz = T_target_source[:, :3, 3, None].unbind(1)
    J_u = camera.fx * (tx - tz * ray_x) * inverse_z
    J_v = camera.fy * (ty - tz * ray_y) * inverse_z
    positions = torch.stack([camera.fx * ray_x + camera.cx, camera.fy * ray_y + camera.cy], 1)
    J_disparity = torch.stack([J_u, J_v], 1)
    return Linearisation(positions, valid, J_target, J_disparity)
