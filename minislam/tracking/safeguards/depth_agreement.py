"""Whether other views measure the same depths, not in the paper.

What the flow shows need not be the parallax of a scene that stands still: a stabilised film bends
its images, water runs, a lens zooms. Depths fit such flow as well, but other depths at each time.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import torch
from torch import Tensor

from minislam.tracking.bundle_adjustment import MIN_DISPARITY, normal_equations
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.reprojection import reproject, scaled_points

MOST_KEYFRAMES = 100  # evenly spread, whose depths are compared
LEAST_INFORMATION = 0.05  # of what is usual in the keyframe: a cell with less is not compared [-]
LEAST_COMMON_FRACTION = 0.15  # fraction of the cells that both sides must see [-]
MIN_AGREEING_VIEWS = 2  # other keyframes that must see a point at the same depth
MAX_DISPARITY_ERROR = 0.05  # relative difference of two views of a point that still agree [-]
NEIGHBOURS = 4  # keyframes on either side that are compared


def depth_difference(graph: KeyframeGraph) -> float | None:
    """Return by how much depths from earlier keyframes differ from those from later ones [-].

    It is |ln(depth / depth)|, the median over the cells of a keyframe, then over the keyframes.
    None: no keyframe has enough cells that keyframes on both sides see.
    """
    step = math.ceil(len(graph.keyframes) / MOST_KEYFRAMES) or 1
    edges = [(p, *ends) for p, ends in enumerate(graph.edges.ends) if ends[0] % step == 0]
    earlier = [position for position, source, target in edges if target < source]
    later = [position for position, source, target in edges if target > source]
    if not (earlier and later):
        return None
    (before, known_before), (after, known_after) = (_measured(graph, p) for p in (earlier, later))
    information = torch.minimum(known_before, known_after)
    differences = []
    for k, row in enumerate(information):
        seen = row > LEAST_INFORMATION * row[row > 0].median() if (row > 0).any() else row > 0
        if seen.float().mean() > LEAST_COMMON_FRACTION:
            differences.append(float((before[k] / after[k])[seen].log().abs().median()))
    return median(differences) if differences else None


def _measured(graph: KeyframeGraph, positions: Sequence[int]) -> tuple[Tensor, Tensor]:  # (K, N)
    """Return the disparities that some edges alone measure, poses held, and their information.

    It is a Gauss-Newton step of Eq. (5) from the disparities that all edges measure.
    """
    problem = bundle_problem(graph, positions)
    problem = replace(problem, free_poses=torch.zeros_like(problem.free_poses))
    equations = normal_equations(problem, graph.state)
    C, known = equations.disparity_diagonal, equations.disparity_diagonal > 0
    moved = equations.disparity_gradient / torch.where(known, C, torch.ones_like(C))
    return (graph.state.disparities + moved).clamp_min(MIN_DISPARITY), C


def agreed_disparities(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (n,)
    """Return the disparities of a keyframe on which enough others agree; all, if none is."""
    needed = min(MIN_AGREEING_VIEWS, len(graph.keyframes) - 1)
    agreed = agreeing_views(graph, keyframe) >= needed
    disparities = graph.keyframes.disparities[keyframe]
    return disparities[agreed] if bool(agreed.any()) else disparities


def agreeing_views(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,) int
    """Count for each cell the other keyframes that have its disparity where they see it."""
    near = range(len(graph.keyframes))[max(0, keyframe - NEIGHBOURS) : keyframe + NEIGHBOURS + 1]
    others = [other for other in near if other != keyframe]
    if not others:
        return torch.zeros_like(graph.grid.rays[:, 0], dtype=torch.int64)
    sources = [keyframe] * len(others)
    positions, valid = reproject(*graph.geometry(sources, others))
    seen, expected = seen_and_expected(graph, sources, others, positions.mT)
    visible = valid & graph.grid.camera.contains(positions.mT)
    return (visible & ((seen - expected).abs() / expected < MAX_DISPARITY_ERROR)).sum(0)


def seen_and_expected(
    graph: KeyframeGraph,
    sources: Tensor | list[int],  # (E,) keyframe index
    targets: Tensor | list[int],  # (E,)
    positions: Tensor,  # (E, N, 2) px, where the targets see the cells of the sources
) -> tuple[Tensor, Tensor]:  # 2 x (E, N) 1/world unit
    """Return the disparities that the targets have there, and those that the sources expect."""
    transforms, disparities, rays, _ = graph.geometry(sources, targets)
    expected = disparities / scaled_points(transforms, disparities, rays)[:, 2].clamp_min(1e-6)
    there = graph.keyframes.disparities[targets][..., None]
    return graph.grid.sample(there, positions)[..., 0], expected
