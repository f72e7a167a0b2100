"""Loop closure: the camera is back at a place, and what has drifted since is set right.

A loop is looked for where the present geometry predicts it (as in the paper), so it is found
while the drift is small against the image. Its flow must be matched in both directions, and the
adjustment must bring its residuals down, or all is as it was before.
"""

import torch
from torch import Tensor

from minislam.tracking.backend import FIRST_WIDENING, BackEnd
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.frame_graph import FAR, both_directions, proximity_pairs
from minislam.tracking.reprojection import lengths


def loop_pairs(
    distances: Tensor,  # (K, K) px, flow distances
    edges: list[tuple[int, int]],  # that exist already
    newest: int,  # keyframe whose loops are looked for
    max_distance: float,  # px
    min_gap: int,  # keyframes between the ends of a loop
    limit: int,  # pairs at most
    suppression: int,  # keyframes around a pair that would repeat it
) -> list[tuple[int, int]]:
    """Return pairs (newest, old) that close a loop."""
    index = torch.arange(len(distances))
    near_in_time = (index[:, None] - index).abs() < min_gap
    candidates = distances.masked_fill(near_in_time, FAR)
    far_edges = [edge for edge in edges if abs(edge[0] - edge[1]) >= min_gap]
    newer = range(newest, newest + 1)
    return proximity_pairs(candidates, far_edges, newer, max_distance, limit, suppression)


def close_loops(backend: BackEnd) -> bool:
    """Close the loops that end at the newest keyframe; return whether there were any.

    All keyframes move, on the flow that is stored: only the new links are measured.
    """
    config, newest = backend.config, len(backend.keyframes) - 1
    if newest < config.loop_min_gap:
        return False
    pairs = loop_pairs(
        backend.distances(rows=range(newest, newest + 1)),
        backend.graph.edges(),
        newest,
        config.loop_distance * backend.pixel_scale,
        config.loop_min_gap,
        config.loop_edges,
        config.loop_suppression,
    )
    edges = backend.confirmed(both_directions(pairs))
    if not edges:
        return False
    before, known = backend.state, len(backend.graph)
    backend.match(edges)
    backend.adjust(0, config.global_iterations, widening=FIRST_WIDENING)
    backend.match(edges)
    backend.adjust(0, config.global_iterations)
    if _residual(backend, known) <= config.max_loop_residual * backend.pixel_scale:
        return True
    backend.state = before
    backend.graph.remove_newest(len(backend.graph) - known)
    return False


def _residual(backend: BackEnd, first_edge: int) -> float:
    """Return the weighted mean length of the residuals of the edges from a position on [px]."""
    problem = backend.problem(range(first_edge, len(backend.graph)), first_free=0)
    residual, _ = residuals(problem, backend.state)
    weight = problem.weights.mean(1)
    return float((weight * lengths(residual)).sum() / weight.sum().clamp_min(1e-6))
