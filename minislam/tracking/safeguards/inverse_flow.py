"""Flow from the newest keyframe back to its predecessors, found without its geometry.

Its disparities come from its predecessor. Where the camera takes wide steps, an error of 10 % is
more than 10 px of flow. A flow that starts there fails, or confirms the error. The flow to the
newest keyframe is known without any geometry; inverted, it is a start that owes nothing to it.
"""

import torch
from torch import Tensor

from minislam.tracking.grid import Grid

ITERATIONS = 4  # of the fixed point; the flow estimator corrects what is left


def inverted_targets(targets: Tensor, grid: Grid) -> Tensor:  # (1, 2, N) px -> (1, 2, N) px
    """Return where the cells of the target lie in the source, from the targets of the source.

    With the flow f, that is q + b(q) for the fixed point b(q) = -f(q + b(q)).
    """
    flow = targets.mT - grid.pixels
    inverse = torch.zeros_like(flow)
    for _ in range(ITERATIONS):
        inverse = -grid.sample(flow, grid.pixels + inverse)
    return (grid.pixels + inverse).mT
