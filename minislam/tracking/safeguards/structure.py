"""Which of the tracker's disparities several keyframes agree on."""

import torch
from torch import Tensor

from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import relative_transforms, reproject, scaled_points

# Relative disagreement of two views of a point that still counts as agreement. [-]
MAX_DISPARITY_ERROR = 0.05
MIN_AGREEING_VIEWS = 2  # other keyframes that must see a point at the same depth
NEIGHBOURS = 4  # keyframes on either side that are compared


def agreeing_views(graph: KeyframeGraph, keyframe_index: int) -> Tensor:  # (N,) int
    """Count for each cell the other keyframes that agree on its depth.

    A cell's point is projected into the other keyframe; they agree if the disparity found there
    differs by less than MAX_DISPARITY_ERROR, relative.
    """
    keyframes, grid = graph.keyframes, graph.grid
    count = len(keyframes)
    low, high = max(0, keyframe_index - NEIGHBOURS), min(count, keyframe_index + NEIGHBOURS + 1)
    others = [k for k in range(low, high) if k != keyframe_index]
    if not others:
        return torch.zeros_like(grid.rays[:, 0], dtype=torch.int64)
    sources = [keyframe_index] * len(others)
    disparities = keyframes.disparities[sources]
    transforms = relative_transforms(keyframes.T_camera_world, sources, others).float()
    depth_ratio = scaled_points(transforms, disparities, grid.rays)[:, 2]
    positions, valid = reproject(transforms, disparities, grid.rays, grid.camera)
    expected = disparities / depth_ratio.clamp_min(1e-6)
    positions = positions.mT
    seen = grid.sample(keyframes.disparities[others][..., None], positions)[..., 0]
    visible = valid & grid.camera.contains(positions)
    error = (seen - expected).abs() / expected
    return (visible & (error < MAX_DISPARITY_ERROR)).sum(0)


def agreed_disparities(graph: KeyframeGraph, keyframe_index: int) -> Tensor:  # (n,)
    """Return the disparities of a keyframe on which enough others agree; all, if none is."""
    needed = min(MIN_AGREEING_VIEWS, len(graph.keyframes) - 1)
    agreed = agreeing_views(graph, keyframe_index) >= needed
    disparities = graph.keyframes.disparities[keyframe_index]
    return disparities[agreed] if bool(agreed.any()) else disparities
