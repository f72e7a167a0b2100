"""The mask M of the disparity prior: where other views contradict the depth of a single image.

A depth network is wrong in places, and there the prior of Eq. (5) would distort poses and
disparities. So every connected keyframe j is warped into keyframe i by its own depth. Where several
views have a correspondence but too few of them agree with D~_i, the prior of i is switched off.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from minislam.geometry import Camera, se3_inverse, transform_points
from minislam.tracking.config import TrackingConfig
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import Edge, KeyframeGraph

MIN_DEPTH = 1e-6  # world units: points at or behind the camera are not seen


@dataclass(frozen=True)
class DepthView:
    """Depth, features and pose of one keyframe, compared with those of other keyframes."""

    metric_depth: Tensor  # (H, W) D~, world units, 0 where unknown
    features: Tensor  # (h', w', C)
    T_camera_world: Tensor  # (4, 4)


def mask_priors(graph: KeyframeGraph, edges: list[Edge], first: int = 0) -> None:
    """Set the masks of the keyframes from `first` on, each by the targets of its edges."""
    config, keyframes = graph.config, graph.keyframes
    if not (config.prior_mask and config.lambda_disparity_prior):
        return
    columns = keyframes.metric_depths, keyframes.features, keyframes.T_camera_world
    rows = enumerate(zip(*columns, strict=True))
    views = {k: DepthView(depth, *seen) for k, (depth, *seen) in rows if depth is not None}
    for index, view in views.items():
        if index >= first:
            targets = dict.fromkeys(target for source, target in edges if source == index)
            others = [views[target] for target in targets if target in views]
            keyframes.prior_masks[index] = prior_mask(graph.grid, view, others, config)


def prior_mask(
    grid: Grid, view: DepthView, others: list[DepthView], config: TrackingConfig
) -> Tensor:  # (N,) bool
    """Return M: False where enough views correspond to a cell and too few of them agree with it."""
    limits = config.mask_max_depth_error, config.mask_min_similarity
    corresponding, consistent = depth_consistency(grid, view, others, *limits)
    is_judged = corresponding >= config.mask_min_corresponding
    return ~(is_judged & (consistent < config.mask_min_consistent))


def depth_consistency(
    grid: Grid,
    view: DepthView,  # i
    others: list[DepthView],  # j, the keyframes that the frame graph connects with i
    max_depth_error: float,  # epsilon, relative
    min_similarity: float,  # gamma, cosine
) -> tuple[Tensor, Tensor]:  # 2 x (N,) int64
    """Count the views from which a similar point comes, and n_i, those of agreeing depth.

    n_i = sum_j [ |D~_i - D~_j->i| / D~_j->i < epsilon  and  cos(F_i, F_j) > gamma ]. Eq. (8).
    """
    stride = grid.stride
    depth = view.metric_depth[::stride, ::stride].reshape(-1)
    cell_features = sample_features(view.features, grid.pixels, grid.camera)
    corresponding = torch.zeros_like(depth, dtype=torch.int64)
    consistent = torch.zeros_like(corresponding)
    for other in others:
        T_view_other = view.T_camera_world @ se3_inverse(other.T_camera_world)
        warped = warp_depth(grid, cell_features, other, T_view_other, min_similarity)
        has_correspondence = (depth > 0) & (warped > 0)
        corresponding += has_correspondence
        consistent += has_correspondence & ((depth - warped).abs() < max_depth_error * warped)
    return corresponding, consistent


def warp_depth(
    grid: Grid,
    cell_features: Tensor,  # (N, C) of this view's cells
    other: DepthView,  # the view whose pixels are warped
    T_view_other: Tensor,  # (4, 4)
    min_similarity: float,  # gamma
) -> Tensor:  # (N,) D~_j->i, 0 where no point with similar features arrives
    """Warp every pixel of another view to the cells of this one by its own depth.

    Several points may fall on one cell. Points whose features differ from the cell's are no
    correspondences. Of the others the nearest counts, because it occludes them: otherwise an
    occluded surface would count as a contradiction.
    """
    camera, depth = grid.camera, other.metric_depth.reshape(-1)
    pixels = camera.pixel_grid(dtype=depth.dtype, device=depth.device).reshape(-1, 2)
    points = camera.backproject(pixels, depth)
    points = transform_points(T_view_other.to(points.dtype), points)
    warped = points[:, 2]
    seen = (depth > 0) & (warped > MIN_DEPTH)
    points = torch.where(seen[:, None], points, points.new_ones(3))  # 1/z would not be finite
    arrived = camera.project(points).round()
    # Only one pixel in stride^2 is a grid cell, whose disparity Eq. (5) estimates.
    seen &= camera.contains(arrived) & (arrived % grid.stride == 0).all(1)

    cell, _ = grid.cells_at(arrived[seen].T)
    features = sample_features(other.features, pixels[seen], camera)
    similar = functional.cosine_similarity(features, cell_features[cell], dim=1) > min_similarity
    nearest = depth.new_full((len(cell_features),), torch.inf)
    nearest.scatter_reduce_(0, cell[similar], warped[seen][similar], "amin")
    return torch.where(nearest.isfinite(), nearest, 0)


def sample_features(
    features: Tensor,  # (h', w', C), patches spread evenly over the image
    pixels: Tensor,  # (N, 2)
    camera: Camera,
) -> Tensor:  # (N, C)
    """Interpolate features bilinearly at pixels; beyond the outermost patches they are repeated."""
    size = pixels.new_tensor([camera.width, camera.height])
    # The image covers [-0.5, size - 0.5], which grid_sample calls [-1, 1].
    position = ((2 * pixels + 1) / size - 1).to(features.dtype)
    image, places = features.permute(2, 0, 1)[None], position[None, None]
    sampled = functional.grid_sample(image, places, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].mT
