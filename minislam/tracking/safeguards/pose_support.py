"""Poses between keyframes that little of the flow supports: other starts, or the frame is lost.

In a wide gap between keyframes the interpolated pose may be too far off for the flow to find the
true one. The pose of a neighbouring frame is a nearer start, once that frame is right itself.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from torch import Tensor

# Support of a pose, relative to the median of all frames between keyframes: [-]
DOUBTFUL_SUPPORT = 0.5  # with less, other starts are tried
LOST_SUPPORT = 0.1  # with less after all starts, the frame is lost


@dataclass(frozen=True)
class PoseFit:
    """A pose and how much of the flow fits it."""

    T_camera_world: Tensor  # (4, 4)
    support: float  # in [0, 1], mean robust weight of all cells


def retry_doubtful(
    fits: dict[int, PoseFit],  # of all frames, changed in place
    others: list[int],  # indices of the frames between keyframes, increasing
    fit_from: Callable[[int, Tensor], PoseFit],  # frame index and start (4, 4) -> fit
) -> list[int]:
    """Start doubtful frames again from the frame before, then from the frame after; keep the best.

    Frames that stay without support are taken out and returned.
    """
    typical = float(np.median([fits[index].support for index in others])) if others else 0.0
    for step in (-1, 1):
        for index in others[::-step]:
            if fits[index].support < DOUBTFUL_SUPPORT * typical and index + step in fits:
                other = fit_from(index, fits[index + step].T_camera_world)
                fits[index] = max(fits[index], other, key=lambda fit: fit.support)
    lost = [index for index in others if fits[index].support < LOST_SUPPORT * typical]
    for index in lost:
        del fits[index]
    return lost
