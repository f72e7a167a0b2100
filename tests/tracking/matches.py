"""Matches (E = 1) between two views of a known room."""

import torch
from torch import Tensor

from minislam.geometry import se3_exp
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.grid import Grid
from minislam.tracking.reprojection import reproject
from tests.tracking.scene import CAMERA, STRIDE, uniform

GRID = Grid.of(CAMERA, STRIDE)
CELLS = len(GRID.rays)


def matches_to(targets: Tensor, confidence: Tensor | float = 1.0) -> FlowMatches:
    """Return the matches (E = 1) with these targets (N, 2)."""
    confidences = (torch.ones(CELLS) * confidence).expand(1, 2, CELLS)
    return FlowMatches(targets.float().T[None], confidences, torch.tensor([0.8]))


def seen_matches(T_target_source: Tensor, disparities: Tensor) -> FlowMatches:
    """Return the true matches of a source whose cells have these disparities (N,)."""
    transform = T_target_source.to(disparities.dtype)[None]
    positions, valid = reproject(transform, disparities[None], GRID.rays, CAMERA)
    assert valid.all()
    return matches_to(positions[0].T)


def room_disparities(seed: int = 0) -> Tensor:
    """Return disparities (N,) float32 of a slanted wall with bumps, median about 0.5."""
    slant = 0.3 + 0.004 * GRID.pixels[:, 0] + 0.002 * GRID.pixels[:, 1]
    return slant + 0.08 * uniform(seed, CELLS).float()


def sideways(length: float = 0.25) -> Tensor:
    return se3_exp(torch.tensor([length, 0.04, 0.05, 0.02, -0.03, 0.04], dtype=torch.float64))
