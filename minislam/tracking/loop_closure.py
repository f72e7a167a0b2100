"""Loop closure: when the camera is back at a place, the drift since then is corrected.

A loop is searched where the present geometry predicts it, as in the paper. Its flow must match in
both directions. If it fits already, it waits for the next adjustment of all keyframes. Else that
follows at once; a loop that does not fit afterwards is removed, and the adjustment is undone.
Where the geometry predicts none, `safeguards/revisits.py` looks for one by appearance.
"""

import torch
from torch import Tensor

from minislam.tracking.frame_graph import FAR, both_directions, proximity_pairs
from minislam.tracking.keyframe_graph import Edge, KeyframeGraph
from minislam.tracking.optimisation import FIRST_WIDENING, FITTING_RESIDUAL, adjust, mean_residual
from minislam.tracking.safeguards.relocalisation import Relocaliser
from minislam.tracking.safeguards.revisits import undo_drift

LOOP_SUPPRESSION = 10  # keyframes: no second loop so near to another, official code
MAX_LOOP_RESIDUAL = 3.0  # px at 320x240: a loop that stays worse than this is undone


def loop_pairs(
    distances: Tensor,  # (K, K) px, flow distances
    edges: list[Edge],  # that exist already
    newest: int,  # keyframe whose loops are looked for
    max_distance: float,  # px
    min_gap: int,  # keyframes, least difference of the ends of a loop
    limit: int,  # pairs at most
) -> list[tuple[int, int]]:
    """Return pairs (newest, old) that close a loop."""
    index = torch.arange(len(distances), device=distances.device)
    near_in_time = (index[:, None] - index).abs() < min_gap
    candidates = distances.masked_fill(near_in_time, FAR)
    taken, newer = loops_near(edges, newest, min_gap), range(newest, newest + 1)
    return proximity_pairs(candidates, taken, newer, max_distance, limit, LOOP_SUPPRESSION)


def loops_near(edges: list[Edge], newest: int, min_gap: int) -> list[Edge]:
    """Return the existing loops that end near the newest keyframe.

    With one, the drift there is corrected, so the geometry predicts the next, and none is sought by
    appearance.
    """
    first = newest - LOOP_SUPPRESSION
    return [(i, j) for i, j in edges if abs(i - j) >= min_gap and max(i, j) >= first]


def close_loops(graph: KeyframeGraph, relocaliser: Relocaliser | None = None) -> bool:
    """Link loops that end at the newest keyframe; return whether all keyframes were adjusted.

    The relocaliser finds those that drift hides from the geometry.
    """
    config, newest = graph.config, len(graph.keyframes) - 1
    before, first_new = graph.state, len(graph.edges)
    edges, is_moved = _loop_edges(graph), False
    is_linked = bool(loops_near(graph.edges.ends, newest, config.loop_min_gap))
    if not edges and relocaliser is not None and not is_linked:
        is_moved = undo_drift(graph, relocaliser)
        edges = _loop_edges(graph) if is_moved else []
    if edges:
        graph.match(edges)
        if not is_moved and mean_residual(graph, first_new) <= FITTING_RESIDUAL * graph.pixel_scale:
            return False
        adjust(graph, 0, config.global_iterations, widening=FIRST_WIDENING)
        graph.match(edges)
        adjust(graph, 0, config.global_iterations)
        if mean_residual(graph, first_new) <= MAX_LOOP_RESIDUAL * graph.pixel_scale:
            return True
    graph.keyframes.set_geometry(before.T_camera_world, before.disparities)
    graph.edges.remove_newest(len(graph.edges) - first_new)
    return False


def _loop_edges(graph: KeyframeGraph) -> list[Edge]:
    """Return edges of the newest keyframe where the geometry predicts loops and flow confirms."""
    config, newest = graph.config, len(graph.keyframes) - 1
    if newest < config.loop_min_gap:
        return []
    limits = config.loop_distance * graph.pixel_scale, config.loop_min_gap, config.loop_edges
    distances = graph.distances(rows=range(newest, newest + 1), limit=limits[0])
    pairs = loop_pairs(distances, graph.edges.ends, newest, *limits)
    return graph.filter_confirmed(both_directions(pairs))
