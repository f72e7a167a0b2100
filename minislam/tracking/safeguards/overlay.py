"""Cells that stand still in the image while the rest of it moves: a logo, a dashboard, bars.

Such an overlay is no part of the scene, but its flow, exactly zero, is well confirmed. A cell of
the scene stands still only now and then: where the camera heads for, or on a dynamic object.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.grid import Grid
from minislam.tracking.reprojection import lengths

STANDS, MOVES = 0.3, 5.0  # px: flow of a cell that stands, median flow where the camera moves
CONFIRMED = 0.2  # confidence of a flow that counts [-]
ALWAYS = 0.8  # of the pairs in which a cell of an overlay stands [-]
MIN_PAIRS = 2  # pairs of keyframes in which the camera moves; fewer tell nothing
MIN_CELLS = 4


def overlay_weights(flow_to_next: Sequence[FlowMatches], grid: Grid) -> Tensor | None:
    """Return a weight (N,) per cell, 0 on an overlay and beside it; None if there is none.

    Beside it, because the flow of a cell is that of the patch around it.
    """
    still = []
    for matches in flow_to_next:
        flow = lengths(matches.targets - grid.pixels.T)[0]
        counts = matches.confidences[0].mean(0) > CONFIRMED
        if bool(counts.any()) and float(flow[counts].median()) > MOVES:
            still.append(counts & (flow < STANDS))
    if len(still) < MIN_PAIRS:
        return None
    is_fixed = torch.stack(still).float().mean(0) >= ALWAYS
    if int(is_fixed.sum()) < MIN_CELLS:
        return None
    covered = max_pool2d(is_fixed.float().reshape(1, 1, *grid.shape), 3, 1, 1).reshape(-1)
    return 1 - covered
