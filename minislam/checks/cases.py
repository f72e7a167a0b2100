"""The inputs of a check: numbers that are the same in every notebook, and drawn ones."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp

# No two of its numbers are equal, so that an exchange of axes is noticed.
CAMERA = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)


@dataclass(frozen=True)
class Case:
    """One input of a check, and what it stands for."""

    arguments: tuple[Any, ...]
    description: str  # completes "for ..."


def doubles(*values: Any) -> Tensor:
    """Return numbers, or lists of numbers, as a float64 tensor."""
    return torch.tensor(values, dtype=torch.float64)


def normals(seed: int, *shape: int) -> Tensor:
    """Return normally distributed numbers, the same for the same seed, for a drawn case."""
    source = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=source, dtype=torch.float64)


def any_pose(seed: int) -> Tensor:
    """Return a pose (4, 4) not far from the identity."""
    return se3_exp(0.1 * normals(seed, 6))


def drawn(draw: Callable[[int], Case]) -> list[Case]:
    """Return three cases, the same in every notebook, and three others where MINISLAM_SEED is set.

    `minislam grade` sets it. `draw` makes a case of a seed.
    """
    hidden = os.environ.get("MINISLAM_SEED", "")
    # A prime number, so that the seeds leave all remainders: some checks draw by `seed % 5`.
    starts = [0, 1009 * (int(hidden) + 1)] if hidden.isdecimal() else [0]
    return [draw(seed) for start in starts for seed in range(start, start + 3)]
