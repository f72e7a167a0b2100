"""Reprojection: where a cell of one keyframe is seen in another, with its derivatives.

A cell with ray r = K^-1 (u, v, 1) and disparity d is the point r / d. In the target frame, and
multiplied by d, which does not change its projection, it is

    X = R r + d t,    T_target_source = (R, t).

So a disparity of zero, a point at infinity, needs no special case. X_z is the depth in the
target divided by the depth in the source.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_inverse

MIN_DEPTH_RATIO = 0.25  # [-], DROID-SLAM's: nearer, flow is unreliable and derivatives explode


@dataclass(frozen=True)
class Linearisation:
    """Reprojections of E edges with N cells each, with derivatives.

    The derivative by the source pose follows from J_target: because T_target_source = T_t T_s^-1,
    a step xi_s of the source acts like the step -Ad(T_target_source) xi_s of the target. So
    J_source = -J_target Ad(T_target_source), with one 6x6 matrix for all cells of an edge.
    """

    positions: Tensor  # (E, 2, N) px
    valid: Tensor  # (E, N) bool: the depth ratio is large enough
    J_target: Tensor  # (E, 6, 2, N) px per unit of xi_target
    J_disparity: Tensor  # (E, 2, N) px per unit of the source's disparity


def relative_transforms(
    T_camera_world: Tensor,  # (K, 4, 4)
    edges_source: Tensor | list[int],  # (E,) keyframe index
    edges_target: Tensor | list[int],  # (E,)
) -> Tensor:  # (E, 4, 4)
    """Return T_target_source of every edge."""
    return T_camera_world[edges_target] @ se3_inverse(T_camera_world[edges_source])


def scaled_points(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N) of the source cells
    rays: Tensor,  # (N, 3) of the source cells, z = 1
) -> Tensor:  # (E, 3, N)
    """Return X = R r + d t for every cell of every edge."""
    return T_target_source[:, :3, :3] @ rays.T + T_target_source[:, :3, 3:] * disparities[:, None]


def reproject(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> tuple[Tensor, Tensor]:  # (E, 2, N) px, (E, N) bool
    """Return the position of every source cell in the target image, and whether it is valid."""
    x, y, z = scaled_points(T_target_source, disparities, rays).unbind(1)
    inverse_z, valid = guarded_inverse(z)
    u = camera.fx * x * inverse_z + camera.cx
    v = camera.fy * y * inverse_z + camera.cy
    return torch.stack([u, v], 1), valid


def guarded_inverse(z: Tensor) -> tuple[Tensor, Tensor]:  # (E, N), (E, N) bool
    """Return 1 / z and where z is valid; elsewhere 1, a finite number for what weighs nothing."""
    valid = z >= MIN_DEPTH_RATIO
    return torch.where(valid, z, torch.ones_like(z)).reciprocal(), valid


def lengths(vectors: Tensor) -> Tensor:  # (E, 2, N) px -> (E, N) px
    """Return the lengths of image vectors; norm(dim=1) would be many times slower."""
    return torch.hypot(vectors[:, 0], vectors[:, 1])


def parallax(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> tuple[Tensor, Tensor, Tensor]:  # (E, N) px, (E, 2, N) px, (E, N) bool
    """Return the parallax of all cells, their positions in the target, and whether both are valid.

    Parallax is the flow that translation causes: all flow minus that of the rotation alone.
    """
    turned, still_seen = reproject(T_target_source, torch.zeros_like(disparities), rays, camera)
    positions, valid = reproject(T_target_source, disparities, rays, camera)
    return lengths(positions - turned), positions, valid & still_seen


def reproject_with_jacobians(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> Linearisation:
    """Return the reprojection with its derivatives (notebook 05 derives them).

    A step of the target's pose moves the point in the target frame, whose ray is X / X_z and whose
    inverse depth is d / X_z: J_target is `Camera.twist_jacobian` there. A larger d moves X along t.
    """
    x, y, z = scaled_points(T_target_source, disparities, rays).unbind(1)
    inverse_z, valid = guarded_inverse(z)
    ray_x, ray_y = x * inverse_z, y * inverse_z
    J_target = camera.twist_jacobian(ray_x, ray_y, disparities * inverse_z)
    tx, ty, tz = T_target_source[:, :3, 3, None].unbind(1)
    J_u = camera.fx * (tx - tz * ray_x) * inverse_z
    J_v = camera.fy * (ty - tz * ray_y) * inverse_z
    positions = torch.stack([camera.fx * ray_x + camera.cx, camera.fy * ray_y + camera.cy], 1)
    return Linearisation(positions, valid, J_target, torch.stack([J_u, J_v], 1))
