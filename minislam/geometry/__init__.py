"""Poses, cameras and alignment: every convention of the package is decided here.

Frames
    A name says the frame. `p_world = T_world_camera @ p_camera`: inner names cancel, so
    `T_a_c = T_a_b @ T_b_c`. Transforms are 4x4 tensors.
Camera
    OpenCV axes: x right, y down, z forward. Depth is z, not the length of the ray.
    Disparity is 1 / depth.
Pixels
    (u, v) = (column, row), and the CENTRE of the first pixel is (0, 0): in the rasteriser, the
    tracker and the data alike. An image therefore covers [-0.5, width - 0.5] in u.
    Resizing by s maps a coordinate c to (c + 0.5) s - 0.5.
Tangent vectors
    xi = (rho, phi), translation first. An update multiplies from the left:
    T_camera_world <- exp(xi) @ T_camera_world.
Quaternions
    w, x, y, z in memory, and the name says so: `quats_wxyz`. Only TUM files hold x, y, z, w.
Images
    (H, W, 3) RGB: `image` is float32 in [0, 1]; what is kept is `pixels`, uint8 in [0, 255].
Units
    Angles in radians. Lengths in world units, which are metres only if the depth prior is metric.
"""

from minislam.geometry.camera import Camera
from minislam.geometry.distortion import BrownDistortion
from minislam.geometry.se3 import (
    se3_adjoint,
    se3_exp,
    se3_interpolate,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    se3_normalised,
    so3_exp,
    so3_log,
    transform_points,
)

__all__ = [
    "BrownDistortion", "Camera", "se3_adjoint", "se3_exp", "se3_interpolate", "se3_inverse",
    "se3_left_jacobian", "se3_log", "se3_normalised", "so3_exp", "so3_log", "transform_points",
]  # fmt: skip
