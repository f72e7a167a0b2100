"""A texture that is a formula, seen at any position: the flow between two views is known."""

import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.priors.flow import STRIDE, ClassicalFlow

HEIGHT, WIDTH = 96, 128
SIZE = (HEIGHT, WIDTH)
GRID = Camera(100, 100, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT).pixel_grid(STRIDE)
INNER = (slice(20, -20), slice(20, -20))  # px that short displacements do not lose
WAVES = 60
SHORTEST, LONGEST = 9.0, 70.0  # px, wavelengths: shorter than DIS can follow, and longer


def brightness(u: np.ndarray, v: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the brightness in [0, 1] of a sum of waves at positions (u, v) [px]."""
    source = np.random.default_rng(seed)
    angles, phases = source.uniform(0, 2 * np.pi, (2, WAVES))
    wavelengths = np.exp(source.uniform(np.log(SHORTEST), np.log(LONGEST), WAVES))
    total = np.zeros_like(u)
    for angle, phase, wavelength in zip(angles, phases, wavelengths, strict=True):
        along = u * np.cos(angle) + v * np.sin(angle)
        total += np.sin(2 * np.pi * along / wavelength + phase)
    return np.clip(0.5 + 0.5 * total / np.sqrt(2 * WAVES), 0, 1)


def view(
    matrix: np.ndarray,  # (2, 2)
    offset: np.ndarray,  # (2,) px
    size: tuple[int, int],  # (height, width)
) -> Tensor:  # (height, width, 3)
    """Return an image that shows at p what the texture holds at matrix p + offset."""
    v, u = np.mgrid[: size[0], : size[1]].astype(np.float64)
    seen = np.stack([u, v], -1) @ np.asarray(matrix).T + offset
    gray = torch.from_numpy(brightness(seen[..., 0], seen[..., 1])).float()
    return gray[..., None].expand(*size, 3)


def shifted(du: float, dv: float, size: tuple[int, int]) -> Tensor:
    """Return the texture moved by (du, dv) px: the flow from shifted(0, 0) to it is (du, dv)."""
    return view(np.eye(2), np.array([-du, -dv]), size)


def flow_of(images: list[Tensor]) -> ClassicalFlow:
    flow = ClassicalFlow()
    for index, image in enumerate(images):
        flow.add_frame(index, image)
    return flow


def still(edges: int = 1) -> Tensor:  # (E, 2, N)
    """Return the start of a flow that expects nothing to move."""
    return GRID.flatten(0, 1).T.expand(edges, 2, -1).clone()


def on_grid(values: Tensor, shape: torch.Size = GRID.shape) -> Tensor:  # (E, 2, N) -> (E, h, w, 2)
    """Return what holds for the cells of E edges in the order of an image."""
    return values.mT.reshape(-1, *shape[:2], 2)


def constant(du: float, dv: float) -> np.ndarray:
    return np.broadcast_to(np.float32([du, dv]), (*SIZE, 2)).copy()
