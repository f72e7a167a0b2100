"""Settled disparities: those that parallax has measured.

Without a depth prior, a new keyframe gets its disparities from its predecessor; where its view is
new, they are filled in from the nearest cells. If one of those is an outlier, a whole strip of the
image is wrong, the robust weight takes it for outliers for ever, and the next keyframe fills in a
wider strip. Therefore only settled cells are handed on. A depth prior settles nothing: it may be
wrong by a tenth.

By its edges e a disparity d has the information sum_e w_e |J_e|^2 (its entry of C in Eq. (5)). So
its relative standard deviation is 1 / sqrt(I) with I = d^2 sum_e w_e |J_e|^2 [px^2], about
sum_e w_e parallax_e^2, which does not depend on the unit of length.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.pose_from_flow import warp_disparities
from minislam.tracking.reprojection import reproject_with_jacobians

SETTLED = 25.0  # px^2, information of a disparity that is known to a fifth of itself


def measured_information(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,) px^2
    """Return the information that the flow of its edges gives to a keyframe's disparities."""
    disparities = graph.keyframes.disparities[keyframe]
    positions = [p for p, edge in enumerate(graph.links.edges) if edge[0] == keyframe]
    if not positions:
        return torch.zeros_like(disparities)
    problem = bundle_problem(graph, positions, 0, lambda_prior=0.0)
    _, weights = residuals(problem, graph.state)
    at = reproject_with_jacobians(*graph.geometry(problem.edges_source, problem.edges_target))
    return disparities.square() * (weights * at.J_disparity.square()).sum((0, 1))


def settled_cells(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,) bool
    """Return which disparities of a keyframe are settled."""
    return measured_information(graph, keyframe) > SETTLED


def hand_on(graph: KeyframeGraph, settled: Tensor, T_camera_world: Tensor) -> Tensor:  # (N,)
    """Return the disparities of the next keyframe, warped from settled cells (N,) of the newest.

    Those with a depth prior are warped, too; if there is none of either, all are. The camera
    moves on to `T_camera_world` (4, 4).
    """
    keyframes = graph.keyframes
    warped = settled | (keyframes.prior_disparities[-1] > 0)
    known = keyframes.disparities[-1] * (warped | ~warped.any())
    motion = keyframes.T_camera_world[-1] @ se3_inverse(T_camera_world)
    return warp_disparities(graph.grid, se3_inverse(motion), known)


def fall_back_on_prior(graph: KeyframeGraph) -> None:
    """Take the prior where flow has settled nothing, as where the camera only turns."""
    for index in range(len(graph.keyframes)):
        graph.keyframes.take_prior(index, ~settled_cells(graph, index))
