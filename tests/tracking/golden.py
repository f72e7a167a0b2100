"""The stored answers of the official bundle adjustment (tests/data/tracking/README.md)."""

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.geometry.se3 import make_transform, rotation_from_quaternion
from minislam.tracking.bundle_problem import BundleProblem, BundleState

FILE = Path(__file__).parents[1] / "data" / "tracking" / "droid_ba.npz"
CONFIDENCE_SCALE = 0.001  # the official code multiplies confidences by this
PRIOR_WEIGHT = 0.05  # alpha of the official code, its lambda_4


@cache
def golden() -> dict[str, Tensor]:
    with np.load(FILE) as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files}


def transforms_of(vectors: Tensor) -> Tensor:  # (..., 7) -> (..., 4, 4)
    """Return T_camera_world of the official (tx, ty, tz, qx, qy, qz, qw)."""
    rotation = rotation_from_quaternion(vectors[..., [6, 3, 4, 5]])
    return make_transform(rotation, vectors[..., :3])


def camera() -> Camera:
    """Return the camera; its pixels are the official grid cells, so the stride is 1."""
    fx, fy, cx, cy = golden()["K"].tolist()
    return Camera(fx, fy, cx, cy, width=8, height=6)


def pixels() -> Tensor:  # (48, 2)
    return camera().pixel_grid(1, torch.float64).reshape(-1, 2)


def state(name: str = "") -> BundleState:
    """Return the initial state, or the end of the case of this name ("A", "B", "C" or "M")."""
    prefix = f"case{name}_exact_" if name else ""
    poses, disparities = golden()[f"{prefix}poses"], golden()[f"{prefix}disps"]
    return BundleState(transforms_of(poses), disparities.reshape(len(disparities), -1))


def problem(first_free: int, prior: bool) -> BundleProblem:
    """Return the official problem: 6 keyframes, 6x8 cells, 20 edges, all disparities free."""
    g = golden()
    known = g["sens"].reshape(6, -1)
    weight = PRIOR_WEIGHT * (known > 0).double() * prior
    return BundleProblem(
        camera=camera(),
        rays=camera().rays(pixels()),
        edges_source=g["ii"],
        edges_target=g["jj"],
        targets=g["target"].flatten(1, 2).mT,
        weights=CONFIDENCE_SCALE * g["conf"].flatten(1, 2).mT,
        prior_disparities=known,
        prior_weights=weight,
        free_poses=torch.arange(6) >= first_free,
        free_disparities=torch.ones(6, dtype=torch.bool),
    )
