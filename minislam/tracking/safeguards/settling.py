"""Settled disparities: those that parallax has measured, of this keyframe or of one before it.

Without a depth prior, a new keyframe gets its disparities from its predecessor; where its view is
new, they are filled in from the nearest cells. If one of those is an outlier, a whole strip of the
image is wrong, the robust weight takes it for outliers for ever, and the next keyframe fills in a
wider strip. Therefore only settled cells are handed on, and the pose of a new frame trusts a cell
as far as it is settled. A depth prior settles nothing: it may be wrong by a tenth.

By its edges e a disparity d has the information sum_e w_e |J_e|^2 (its entry of C in Eq. (5)). So
its relative standard deviation is 1 / sqrt(I) with I = d^2 sum_e w_e |J_e|^2 [px^2], about
sum_e w_e parallax_e^2, which does not depend on the unit of length.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.state.stateful import Stateful
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.pose_from_flow import warp_disparities
from minislam.tracking.reprojection import reproject, reproject_with_jacobians

SETTLED = 25.0  # px^2, information of a disparity that is known to a fifth of itself
HANDED_ON = 0.5  # of the information: neighbouring keyframes see much of the same flow [-]
MOST = 1e6  # px^2, cap of the information: an infinite one could not be interpolated
LEAST = 0.05  # weight of a cell whose disparity nothing is known of: it still shows a rotation [-]


class Settling(Stateful):
    """Tells how well the newest keyframe's disparities are settled, and hands them on."""

    handed_on: Tensor  # (N,) px^2, the newest keyframe's information from its predecessor

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        self.handed_on = torch.zeros_like(graph.grid.rays[:, 0])

    def information(self) -> Tensor:  # (N,) px^2
        """Return the information of the newest keyframe's disparities from flow, so far."""
        graph, newest = self._graph, len(self._graph.keyframes) - 1
        information = measured_information(graph, newest)
        return information if graph.follows_a_loss(newest) else information + self.handed_on

    def certainty(self, information: Tensor) -> Tensor:  # (N,) px^2 -> (N,) in (0, 1]
        """Return the weight of cells in a pose: 1/2 if just settled, 1 with a depth prior."""
        settled = (1 / (1 + SETTLED / information)).clamp_min(LEAST)
        return torch.where(self._has_prior, 1.0, settled)

    @property
    def _has_prior(self) -> Tensor:  # (N,) bool
        return self._graph.keyframes.prior_disparities[-1] > 0

    def fall_back_on_prior(self) -> None:
        """Take the prior where flow has settled nothing, as where the camera only turns."""
        for index in range(len(self._graph.keyframes)):
            unsettled = measured_information(self._graph, index) <= SETTLED
            self._graph.keyframes.take_prior(index, unsettled)

    def hand_on(self, information: Tensor, T_camera_world: Tensor) -> Tensor:  # (N,)
        """Return the disparities of the next keyframe, warped from settled cells of the newest.

        Those with a depth prior are warped, too; if there is none of either, all are. The camera
        moves on to `T_camera_world` (4, 4). The new cells inherit a part of the information (N,).
        """
        grid, keyframes = self._graph.grid, self._graph.keyframes
        settled = information > SETTLED
        warped = settled | self._has_prior
        sources = keyframes.disparities[-1] * (warped | ~warped.any())
        motion = keyframes.T_camera_world[-1] @ se3_inverse(T_camera_world)
        disparities = warp_disparities(grid, se3_inverse(motion), sources)
        inherited = HANDED_ON * torch.where(settled, information, 0).clamp_max(MOST)
        motion = motion[None].to(disparities.dtype)
        positions, valid = reproject(motion, disparities[None], grid.rays, grid.camera)
        there = grid.sample(inherited[None, :, None], positions.mT)[0, :, 0]
        self.handed_on = torch.where(valid[0] & grid.camera.contains(positions[0].mT), there, 0)
        return disparities


def measured_information(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,) px^2
    """Return the information I above on the disparities of a keyframe, from its edges' flow."""
    disparities = graph.keyframes.disparities[keyframe]
    positions = [p for p, edge in enumerate(graph.edges.ends) if edge[0] == keyframe]
    if not positions:
        return torch.zeros_like(disparities)
    problem = bundle_problem(graph, positions)
    _, weights = residuals(problem, graph.state)
    at = reproject_with_jacobians(*graph.geometry(problem.edges_source, problem.edges_target))
    return disparities.square() * (weights * at.J_disparity.square()).sum((0, 1))
