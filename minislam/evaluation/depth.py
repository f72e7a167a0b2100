"""Error of the depth that the map renders."""

import numpy as np
from numpy.typing import ArrayLike

from minislam.errors import InputError


def depth_l1(
    depth: ArrayLike,  # (H, W) world units of the map, 0 where unknown
    reference: ArrayLike,  # (H, W) world units of the truth, 0 where unknown
    scale: float,  # units of the truth per unit of the map, from a Sim(3) of the trajectories
    moving: ArrayLike | None = None,  # (H, W) bool, True where a dynamic object hides the scene
) -> float | None:  # units of the truth
    """Return the mean |scale D^ - D| over static pixels known to both; None if there is none.

    The scale is that of the trajectory, not fitted to the depths: a map too large for its
    trajectory is an error.
    """
    depth, reference = np.asarray(depth, np.float64), np.asarray(reference, np.float64)
    hidden = np.zeros(depth.shape, bool) if moving is None else np.asarray(moving, bool)
    if not depth.shape == reference.shape == hidden.shape:
        raise InputError(
            f"expected depths and mask of one size, found {depth.shape}, {reference.shape} and "
            f"{hidden.shape}; render at the size of the reference"
        )
    known = (depth > 0) & (reference > 0) & ~hidden
    if not known.any():
        return None
    return float(np.abs(scale * depth - reference)[known].mean())
