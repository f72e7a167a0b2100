"""The focal length as one more unknown of Eq. (5): its Jacobian.

The unknown is s = ln(f / f_0), so that fx and fy keep their ratio and f stays positive. A longer
focal length does two things. It spreads the target image, u = fx X_x / X_z + cx, and it narrows
the fan of rays from the source, whose pixels stay where they are:

    r = ((u - cx) / fx, (v - cy) / fy, 1)    =>    dr/ds = (-r_x, -r_y, 0),   dX/ds = R dr/ds.

With the target's ray (a, b, 1) = X / X_z, both together are

    du/ds = fx (a + (dX_x/ds - a dX_z/ds) / X_z),      dv/ds alike with fy and b.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.tracking import reprojection

MOST_ZOOM = math.log(20)  # either way: where nothing moves any focal length fits, even an infinite


def within_reach(log_focal: float) -> float:
    """Return the nearest s that a lens could have."""
    return min(max(log_focal, -MOST_ZOOM), MOST_ZOOM)


def zoomed(camera: Camera, rays: Tensor, log_focal: float) -> tuple[Camera, Tensor]:
    """Return camera and rays (N, 3) of the same pixels with both focal lengths exp(s) as long."""
    if log_focal == 0:
        return camera, rays
    factor = math.exp(log_focal)
    camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    return camera, rays / rays.new_tensor([factor, factor, 1.0])


def reproject_with_focal(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3) at s = 0
    camera: Camera,  # at s = 0
    log_focal: float,  # s
    is_free: bool,  # append the column of s to J_target
) -> reprojection.Linearisation:
    """Return the reprojection at s with its derivatives. Eq. (5)."""
    camera, rays = zoomed(camera, rays, log_focal)
    found = reprojection.reproject_with_jacobians(T_target_source, disparities, rays, camera)
    if not is_free:
        return found
    column = focal_jacobian(T_target_source, disparities, rays, camera)
    return replace(found, J_target=torch.cat([found.J_target, column[:, None]], 1))


def focal_jacobian(
    T_target_source: Tensor,  # (E, 4, 4)
    disparities: Tensor,  # (E, N)
    rays: Tensor,  # (N, 3)
    camera: Camera,
) -> Tensor:  # (E, 2, N) px per unit of s
    """Return the derivative of all reprojections by s = ln(f / f_0). Eq. (5)."""
    x, y, z = reprojection.scaled_points(T_target_source, disparities, rays).unbind(1)
    narrowed = rays * rays.new_tensor([-1.0, -1.0, 0.0])
    dx, dy, dz = (T_target_source[:, :3, :3] @ narrowed.T).unbind(1)
    inverse_z, _ = reprojection.guarded_inverse(z)
    a, b = x * inverse_z, y * inverse_z
    J_u = camera.fx * (a + (dx - a * dz) * inverse_z)
    J_v = camera.fy * (b + (dy - b * dz) * inverse_z)
    return torch.stack([J_u, J_v], 1)
