"""Cameras and rigid motions, in numpy and on purpose not shared with the package under test.

The world is right-handed with z up; a camera looks along its own z, with x right and y down.
The centre of the first pixel is (0, 0).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

Array = np.ndarray

REFERENCE_WIDTH, REFERENCE_HEIGHT = 320, 240  # px, the size the focal length is quoted for
REFERENCE_FOCAL = 272.0  # px at the reference width: 61 degrees of horizontal view
REFERENCE_PRINCIPAL_POINT = (162.7, 117.8)  # px, off the middle (159.5, 119.5) as real lenses are


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def default_intrinsics(size: tuple[int, int]) -> Intrinsics:
    """Return the camera of all sequences at an image size (width, height)."""
    width, height = size
    scale_x, scale_y = width / REFERENCE_WIDTH, height / REFERENCE_HEIGHT
    # One focal length for both axes keeps the pixels square at any aspect ratio.
    focal = REFERENCE_FOCAL * scale_x
    return Intrinsics(
        fx=focal,
        fy=focal,
        cx=(REFERENCE_PRINCIPAL_POINT[0] + 0.5) * scale_x - 0.5,
        cy=(REFERENCE_PRINCIPAL_POINT[1] + 0.5) * scale_y - 0.5,
        width=width,
        height=height,
    )


def rigid(rotation: Array, translation: Array) -> Array:
    """Return the 4x4 transform made of a rotation (3, 3) and a translation (3,)."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def rotation_about_z(angle: float) -> Array:
    """Return the rotation (3, 3) by an angle [rad] about the vertical."""
    return Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()


def upright(position: ArrayLike, yaw: float = 0.0) -> Array:
    """Return T_world_body of a thing standing upright, turned by yaw [rad]."""
    return rigid(rotation_about_z(yaw), np.asarray(position, float))


def look_at(position: Array, target: Array) -> Array:
    """Return T_world_camera of a level camera at position that looks at target."""
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return rigid(np.stack([right, down, forward], axis=1), position)


def frame_along(start: Array, end: Array, side: Array) -> Array:
    """Return T_world_body centred between two points, z along them, x close to side."""
    axis = end - start
    axis = axis / np.linalg.norm(axis)
    x_axis = side - axis * (axis @ side)
    x_axis = x_axis / np.linalg.norm(x_axis)
    y_axis = np.cross(axis, x_axis)
    return rigid(np.stack([x_axis, y_axis, axis], axis=1), (start + end) / 2)
