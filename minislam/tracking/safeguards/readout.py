"""Tells whether the camera has a rolling shutter: only then its readout is an unknown of Eq. (5).

The readout of a global shutter would follow noise and movers. So it counts only if it explains the
flow clearly better. In warm-ups and whole runs of rolling shutters it saved 3 to 37 % of the cost,
of clips with a global shutter or with hardly any turn at most 1.2 %.
"""

from dataclasses import replace

import torch

from minislam.tracking.bundle_adjustment import bundle_adjust
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.safeguards.focal_length import ITERATIONS, MIN_RESIDUAL, MOST_KEYFRAMES
from minislam.tracking.safeguards.touched import of_rows

WORTH_SAVING = 0.02  # fraction of the cost


def seek_readouts(graph: KeyframeGraph) -> None:
    """Set the readout that the flow fits if it saves enough; poses and depths stay.

    A sensor is read along one axis: the readout that displaces the flow more is set, and the
    adjustments of all keyframes refine it from then on.
    """
    shutter, edges = graph.shutter, enumerate(graph.links.edges())
    positions = [position for position, edge in edges if max(edge) < MOST_KEYFRAMES]
    columns = shutter.link_columns(positions)
    if columns is None or shutter.axis is not None:
        return
    problem = bundle_problem(graph, positions, 0, lambda_prior=0.0)
    problem = replace(problem, free_focal=graph.focal_is_free)
    rows = torch.arange(min(MOST_KEYFRAMES, len(graph.keyframes)), device=columns.device)
    problem, start = of_rows(problem, graph.state, rows)
    _, held = bundle_adjust(problem, start, ITERATIONS)
    state, free = bundle_adjust(replace(problem, shutter=columns), start, ITERATIONS)
    floor = MIN_RESIDUAL**2 * float(problem.weights.mean(1).sum())
    if held.cost_after - free.cost_after > WORTH_SAVING * max(held.cost_after, floor):
        (across, down), moved = state.readout, columns.abs().mean((0, 2, 3))
        is_down = bool(abs(down) * moved[1] > abs(across) * moved[0])
        shutter.axis = int(is_down)
        shutter.lengthen((0.0, down) if is_down else (across, 0.0))
