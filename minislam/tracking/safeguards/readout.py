"""Tells whether the camera has a rolling shutter: only then the readouts are unknowns of Eq. (5).

Readouts of a global shutter would follow noise and movers. So they count only if they explain the
flow clearly better. In warm-ups and whole runs of rolling shutters they saved 3 to 37 % of the
cost, of clips with a global shutter or with hardly any turn at most 1.2 %.
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
    """Set the readouts that the flow fits if they save enough; poses and depths stay.

    From then on the adjustments of all keyframes refine them.
    """
    shutter, edges = graph.shutter, enumerate(graph.links.edges())
    positions = [position for position, edge in edges if max(edge) < MOST_KEYFRAMES]
    columns = shutter.link_columns(positions)
    if shutter.is_found or columns is None:
        return
    problem = bundle_problem(graph, positions, 0, lambda_prior=0.0)
    problem = replace(problem, free_focal=graph.focal_is_free)
    rows = torch.arange(min(MOST_KEYFRAMES, len(graph.keyframes)), device=columns.device)
    problem, start = of_rows(problem, graph.state, rows)
    _, held = bundle_adjust(problem, start, ITERATIONS)
    state, free = bundle_adjust(replace(problem, shutter=columns), start, ITERATIONS)
    floor = MIN_RESIDUAL**2 * float(problem.weights.mean(1).sum())
    if held.cost_after - free.cost_after > WORTH_SAVING * max(held.cost_after, floor):
        shutter.is_found = True
        shutter.lengthen(state.readout)
