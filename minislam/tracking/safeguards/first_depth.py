"""Which of several first depths is taken, where the flow hardly tells them apart.

Under a long lens, or where the camera hardly walks, a scene and its mirror image in depth have
nearly the same flow. The paper starts from the depth prior, which tells them apart.
"""

import math

import torch
from torch import Tensor

from minislam.tracking.bundle_adjustment import BundleReport, BundleState
from minislam.tracking.grid import Grid

# Chosen on five real clips, four in which the camera hardly does more than turn, judged on others.
FOCAL_WORTH_SAVING = 0.05  # of the cost, for each doubling of the guessed focal length [-]
FARTHEST = math.log(4)  # of the guessed focal length: what is farther is one of a failed start
RELIEF_WORTH_SAVING = 0.1  # of the cost, if disparities do not correlate with the usual ones [-]

Found = tuple[BundleState, BundleReport]


def cost_of(found: Found) -> float:  # px^2
    """Return the cost at which an adjustment ended."""
    return found[1].cost_after


def most_plausible(grid: Grid, known_disparities: Tensor, found: list[Found]) -> Found:
    """Return the result of lowest cost; what is usual decides between nearly equal ones.

    Usual are the guessed focal length, and disparities that grow with those of the depth prior, or
    without one towards the lower edge of the image.
    """
    known = known_disparities > 0  # (K, N)
    usual, cells = grid.pixels[:, 1].expand_as(known), torch.ones_like(known)
    if known.any():
        usual, cells = known_disparities.log(), known

    def implausible_cost(result: Found) -> float:
        state, report = result
        if abs(state.log_focal) > FARTHEST:
            return math.inf
        disparities = state.disparities.log()
        agrees = torch.corrcoef(torch.stack([usual[cells], disparities[cells]]))[0, 1]
        doublings = abs(state.log_focal) / math.log(2)
        unusual = FOCAL_WORTH_SAVING * doublings - RELIEF_WORTH_SAVING * float(agrees.nan_to_num())
        return report.cost_after * (1 + unusual)

    return min(found, key=implausible_cost)
