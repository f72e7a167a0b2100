"""Deform the map when bundle adjustment changes its keyframes (Sec. 3.4)."""

from dataclasses import replace

from torch import Tensor

from minislam.geometry import se3_inverse, transform_points
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
