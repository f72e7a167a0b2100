"""Deform the map when bundle adjustment changes its keyframes (Sec. 3.4)."""

from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_inverse, transform_points
from minislam.geometry.se3 import quaternion_from_rotation, quaternion_product
from minislam.splatting import GaussianMap


def deform_rigidly(
    gaussians: GaussianMap,
    anchor_rows: Tensor,  # (N,) int64, row of each Gaussian's keyframe in the poses below
    T_old_camera_world: Tensor,  # (K, 4, 4) float64
    T_new_camera_world: Tensor,  # (K, 4, 4) float64
) -> GaussianMap:
    """Move each Gaussian with its anchor keyframe: mu <- T mu, q <- q(T) q.

    T = T_world_new_camera @ T_old_camera_world. It is composed in float64, because in float32 a
    rotation below 1e-4 rad would be lost in the quaternion. Scale and opacity do not change.
    """
    motion = se3_inverse(T_new_camera_world) @ T_old_camera_world  # (K, 4, 4) world to world
    turn = quaternion_from_rotation(motion[:, :3, :3])
    dtype = gaussians.means.dtype
    points = gaussians.means.detach().double()[:, None]
    means = transform_points(motion[anchor_rows], points)[:, 0]
    quats = quaternion_product(turn[anchor_rows], gaussians.quats_wxyz.detach().double())
    return replace(gaussians.detach(), means=means.to(dtype), quats_wxyz=quats.to(dtype))


def rescale_to_depths(
    gaussians: GaussianMap,
    anchor_rows: Tensor,  # (N,) int64, row of each Gaussian's keyframe below
    T_camera_world: Tensor,  # (K, 4, 4) float64, poses at which the OLD depths hold
    old_depths: list[Tensor],  # K x (H, W) world units, 0 where unknown
    new_depths: list[Tensor],  # K x (H, W) world units, 0 where unknown
    camera: Camera,
) -> GaussianMap:
    """Move Gaussians along the rays of their anchor when its reference depth changes.

    As in Splat-SLAM, z and the scales are multiplied by s = 1 + (D_new - D_old) / z, with the
    depths at the pixel of the Gaussian. Where one is unknown or s is not positive, s is 1.
    """
    means = gaussians.means.detach().double().clone()
    log_scales = gaussians.log_scales.detach().clone()
    for row, (old, new) in enumerate(zip(old_depths, new_depths, strict=True)):
        anchored = (anchor_rows == row).nonzero().squeeze(-1)
        points = transform_points(T_camera_world[row], means[anchored])
        factor = _depth_factor(points, old, new, camera)
        means[anchored] = transform_points(
            se3_inverse(T_camera_world[row]), points * factor[:, None]
        )
        log_scales[anchored] += factor.log()[:, None].to(log_scales)
    dtype = gaussians.means.dtype
    return replace(gaussians.detach(), means=means.to(dtype), log_scales=log_scales)


def _depth_factor(points_camera: Tensor, old: Tensor, new: Tensor, camera: Camera) -> Tensor:
    """Return s (M,) of points (M, 3) in the camera frame; 1 where it is unknown."""
    z = points_camera[:, 2]
    in_front = z > 0
    safe = torch.where(in_front[:, None], points_camera, torch.ones_like(points_camera))
    pixels = camera.project(safe).round().long()
    known = in_front & camera.contains(pixels)
    column, row = (pixels * known[:, None]).unbind(-1)
    before, after = old[row, column].to(z), new[row, column].to(z)
    factor = 1 + (after - before) / safe[:, 2]
    known = known & (before > 0) & (after > 0) & (factor > 0)
    return torch.where(known, factor, torch.ones_like(factor))
