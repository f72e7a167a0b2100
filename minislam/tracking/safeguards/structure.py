"""Depth images from the tracker's own disparities, for footage without a depth prior."""

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import relative_transforms, reproject, scaled_points

# Relative disagreement of two views of a point that still counts as agreement. [-]
MAX_DISPARITY_ERROR = 0.05
MIN_AGREEING_VIEWS = 2  # other keyframes that must see a point at the same depth
NEIGHBOURS = 4  # keyframes on either side that are compared
EDGE_RATIO = 1.15  # neighbouring cells whose depths differ more lie on different surfaces


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
        return torch.zeros(len(grid.rays), dtype=torch.int64)
    sources, targets = torch.full((len(others),), keyframe_index), torch.tensor(others)
    disparities = keyframes.disparities[sources]
    transforms = relative_transforms(keyframes.T_camera_world, sources, targets).float()
    depth_ratio = scaled_points(transforms, disparities, grid.rays)[:, 2]
    positions, valid = reproject(transforms, disparities, grid.rays, grid.camera)
    expected = disparities / depth_ratio.clamp_min(1e-6)
    positions = positions.mT
    seen = grid.sample(keyframes.disparities[targets][..., None], positions)[..., 0]
    visible = valid & grid.camera.contains(positions)
    error = (seen - expected).abs() / expected
    return (visible & (error < MAX_DISPARITY_ERROR)).sum(0)


def depth_from_disparities(
    graph: KeyframeGraph, keyframe_index: int
) -> Tensor:  # (H, W), 0: unknown
    """Return a depth image: cells on which several views agree, interpolated between them.

    Pixels between cells of two surfaces stay unknown.
    """
    grid, keyframes = graph.grid, graph.keyframes
    disparities = keyframes.disparities[keyframe_index].reshape(grid.shape).numpy()
    needed = min(MIN_AGREEING_VIEWS, len(keyframes) - 1)
    agreed = (agreeing_views(graph, keyframe_index) >= needed).reshape(grid.shape).numpy()
    static = keyframes.static_weights[keyframe_index].reshape(grid.shape).numpy() > 0
    square = np.ones((2, 2), np.uint8)
    largest = cv2.dilate(disparities, square, anchor=(0, 0))
    smallest = cv2.erode(disparities, square, anchor=(0, 0))
    smooth = largest < EDGE_RATIO * smallest
    usable = cv2.erode((agreed & static).astype(np.uint8), square, anchor=(0, 0))
    known = (usable > 0) & smooth  # of the square between a cell and its right and lower ones

    column, row = np.meshgrid(
        np.arange(grid.camera.width, dtype=np.float32) / grid.stride,
        np.arange(grid.camera.height, dtype=np.float32) / grid.stride,
    )
    dense = cv2.remap(disparities, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = known[row.astype(int), column.astype(int)]
    depth = np.where(inside, 1 / np.maximum(dense, 1e-6), 0).astype(np.float32)
    return torch.from_numpy(depth)
