"""Motion memory: the motion weight of each cell, passed on along the flow.

While a dynamic object is small, the robust weight alone excludes it. Once it fills half of the
image, the pose follows it, not the static scene, and beta learns from wrong poses. So each cell has
a motion weight: how well its flow has fitted the camera motion. The cell it flows to inherits it.

An overlay, such as a logo, stands still in the image while the camera moves: its weight is 0.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from minislam.geometry import se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import filled_from_nearest
from minislam.tracking.reprojection import lengths, reproject

MIN_CONFIDENCE = 0.1  # of a match that passes motion weights on [-]
LOSS_RATE, RECOVERY_RATE = 0.9, 0.1  # fast and slow, because a moving object may pause [-]
DEPTH_ERROR = 0.1  # of a depth prior, relative: so much of the parallax is no motion [-]
STANDS, MOVES = 0.3, 5.0  # px: flow of a cell that stands, median flow where the camera moves
CONFIRMED = 0.2  # confidence of a flow that may tell an overlay [-]
ALWAYS = 0.8  # of the pairs in which a cell of an overlay stands [-]
MIN_PAIRS = 2  # pairs of keyframes in which the camera moves; fewer tell nothing
MIN_CELLS = 4  # of an overlay; fewer stand still by chance
REACH = 2  # cells around an overlay left out too: their flow mixes it with the scene


def judge_all(graph: KeyframeGraph) -> None:
    """Set all motion weights by the present geometry; after a lost camera memory begins anew."""
    keyframes = graph.keyframes
    for index, matches in enumerate([None, *graph.flow_to_next]):
        if matches is None:
            keyframes.motion_weights[index] = 1
        else:
            remember(graph, matches, keyframes.T_camera_world[index], index - 1)
            inherit(graph, matches, index)


def remember(
    graph: KeyframeGraph,
    matches: FlowMatches,
    T_camera_world: Tensor,  # (4, 4) where the camera moves on to
    index: int = -1,
    settled: Tensor | None = None,  # (N,) bool, cells whose disparity is measured; None: all
) -> None:
    """Lower the motion weight of a keyframe's cells whose flow does not fit the camera motion.

    A wrong disparity does not fit either, so a cell that is not settled keeps its weight.
    """
    keyframes, scale = graph.keyframes, graph.config.motion_memory * graph.pixel_scale
    if not scale:
        return
    before = keyframes.motion_weights[index]
    motion = T_camera_world @ se3_inverse(keyframes.T_camera_world[index])
    step = keyframes.disparities[index], motion, before, scale
    after = update_motion_weight(graph.grid, matches, *step)
    weight = after if settled is None else torch.where(settled, after, before)
    keyframes.motion_weights[index] = weight


def inherit(graph: KeyframeGraph, matches: FlowMatches, index: int = -1) -> None:
    """Set the motion weights of a keyframe from those of the keyframe before it."""
    weights = graph.keyframes.motion_weights
    weights[index] = inherit_motion_weight(graph.grid, matches, weights[index - 1])


def update_motion_weight(
    grid: Grid,
    matches: FlowMatches,  # E = 1, source to target
    disparities: Tensor,  # (N,) of the source
    T_target_source: Tensor,  # (4, 4)
    weight: Tensor,  # (N,) of the source cells so far, in [0, 1]
    scale: float,  # px, of the residuals that still fit the camera motion
) -> Tensor:  # (N,)
    """Return the motion weight of the source cells after one more step of the camera."""
    motion = T_target_source[None].to(disparities.dtype)
    positions, valid = reproject(motion, disparities[None], grid.rays, grid.camera)
    squared = (positions[0] - matches.targets[0]).square().sum(0)
    # Parallax has the relative error of the depth, so it widens the tolerance.
    turned, _ = reproject(motion, torch.zeros_like(disparities)[None], grid.rays, grid.camera)
    parallax2 = (positions[0] - turned[0]).square().sum(0)
    agreement = (1 + squared / (scale**2 + DEPTH_ERROR**2 * parallax2)) ** -2
    rate = torch.where(agreement < weight, LOSS_RATE, RECOVERY_RATE)
    return torch.where(valid[0] & _is_matched(matches), weight.lerp(agreement, rate), weight)


def inherit_motion_weight(grid: Grid, matches: FlowMatches, weight: Tensor) -> Tensor:  # (N,)
    """Return the motion weight of the target cells: that of the source cells that flow there.

    Of several source cells the lowest weight counts. A target cell without any takes the weight of
    the nearest one; if no flow arrives at all, every weight is 1.
    """
    inherited = _inherited(grid, matches, weight)
    if bool(inherited.isinf().all()):
        return torch.ones_like(weight)
    return filled_from_nearest(inherited, inherited.isinf())


def arrived(grid: Grid, matches: FlowMatches, marks: Tensor) -> Tensor:  # (N,) 0 or 1
    """Return the marks of the target cells; one without takes the largest beside it, or 0."""
    marked = _inherited(grid, matches, marks)
    marked[marked.isinf()] = -1
    beside = max_pool2d(marked[None, None], 3, 1, 1)[0, 0]
    return torch.where(marked < 0, beside.clamp_min(0), marked).reshape(-1)


def _inherited(grid: Grid, matches: FlowMatches, values: Tensor) -> Tensor:  # (h, w), inf: none
    """Return the lowest value of the source cells that flow to each target cell."""
    cell, inside = grid.cells_at(matches.targets[0])
    arrives = inside & _is_matched(matches)
    unknown = torch.full_like(values, torch.inf)
    return unknown.scatter_reduce(0, cell[arrives], values[arrives], "amin").reshape(grid.shape)


def _is_matched(matches: FlowMatches) -> Tensor:  # (N,) bool
    return matches.confidences[0].mean(0) > MIN_CONFIDENCE


def overlay_weights(flow_to_next: Sequence[FlowMatches], grid: Grid) -> Tensor | None:
    """Return a weight (N,) per cell, 0 on an overlay and beside it; None if there is none.

    An overlay is a logo, a dashboard, black bars. In most pairs in which the camera moves it stands
    still, and forward and backward flow agree; a cell of the scene does so only now and then.
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
    fixed = is_fixed.float().reshape(1, 1, *grid.shape)
    return 1 - max_pool2d(fixed, 2 * REACH + 1, 1, REACH).reshape(-1)


def without_overlay(matches: FlowMatches, overlay: Tensor | None) -> FlowMatches:
    """Return matches in which no cell of an overlay counts, by its `overlay_weights`.

    Its zero flow would delay keyframes, and its low motion weight would spread by wrong matches.
    Its cells, which always match, would hide that the camera is lost.
    """
    if overlay is None:
        return matches
    kept = matches.confidences * overlay
    of_matched = kept.sum((1, 2)) / matches.confidences.sum((1, 2)).clamp_min(1e-6)
    ratios = matches.matched_ratios * of_matched / overlay.mean().clamp_min(1e-6)
    return replace(matches, confidences=kept, matched_ratios=ratios.clamp_max(1))
