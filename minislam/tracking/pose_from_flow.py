"""Pose and disparities of one new image from its optical flow: how every keyframe starts."""

import torch
from scipy import ndimage
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import bundle_adjust, edge_costs
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.grid import Grid
from minislam.tracking.reprojection import reproject, scaled_points
from minislam.tracking.safeguards.robust import RobustKernel

INVERSION_STEPS = 4  # of a fixed point; the flow estimator corrects what is left
POSE_ITERATIONS = 6  # Gauss-Newton steps per width of the robust weight
ROBUST_WIDENING = (16.0, 4.0, 1.0)  # times the width: a start off by 10 degrees has 50 px [-]


def compose_matches(first: FlowMatches, second: FlowMatches, grid: Grid) -> FlowMatches:
    """Return the matches a -> c from matches a -> b and b -> c (E = 1 each)."""
    middle = first.targets.mT
    flow = second.targets.mT - grid.pixels
    targets = first.targets + grid.sample(flow, middle).mT
    confidences = first.confidences * grid.sample(second.confidences.mT, middle).mT
    return FlowMatches(targets, confidences, first.matched_ratios * second.matched_ratios)


def inverted_targets(targets: Tensor, grid: Grid) -> Tensor:  # (1, 2, N) px -> (1, 2, N) px
    """Return where the cells of the target lie in the source, from the targets of the source.

    With the flow f, that is q + b(q) for the fixed point b(q) = -f(q + b(q)). Flow back from a new
    keyframe starts there: it owes nothing to the disparities, which are those of its predecessor.
    """
    flow = targets.mT - grid.pixels
    inverse = torch.zeros_like(flow)
    for _ in range(INVERSION_STEPS):
        inverse = -grid.sample(flow, grid.pixels + inverse)
    return (grid.pixels + inverse).mT


def motion_only_problem(
    grid: Grid,
    edges_source: Tensor,  # (E,) int64
    edges_target: Tensor,  # (E,) int64
    targets: Tensor,  # (E, 2, N) px
    weights: Tensor,  # (E, 2, N)
    free_poses: Tensor,  # (K,) bool
    robust: RobustKernel | None,
) -> BundleProblem:
    """Return a bundle problem in which only poses move: disparities held, no prior."""
    no_prior = grid.rays.new_zeros(len(free_poses), len(grid.rays))
    return BundleProblem(
        camera=grid.camera, rays=grid.rays,
        edges_source=edges_source, edges_target=edges_target, targets=targets, weights=weights,
        prior_disparities=no_prior, prior_weights=no_prior,
        free_poses=free_poses, free_disparities=torch.zeros_like(free_poses), robust=robust,
    )  # fmt: skip


def start_pose(
    grid: Grid,
    matches: FlowMatches,  # E = 1, source to target
    disparities: Tensor,  # (N,) of the source
    cell_weights: Tensor,  # (N,) in [0, 1] of the source
    T_source_world: Tensor,  # (4, 4)
    starts: list[Tensor],  # candidates (4, 4) for T_target_world
    robust: RobustKernel | None,
) -> Tensor:
    """Return T_target_world (4, 4) that explains the flow best.

    Each start is optimised with the robust scale shrunk from 16 c, from 4 c and at c; the pose of
    lowest final cost is returned. A wide scale converges from far, but it can lock onto a near
    dynamic object. All candidates are solved together, as the target poses of one problem.
    """
    candidates: list[Tensor] = []
    for widening in ROBUST_WIDENING if robust else (1.0,):
        candidates += starts
        count = len(candidates)
        numbers = torch.arange(count + 1, device=disparities.device)
        weights = (matches.confidences * cell_weights).expand(count, -1, -1)
        ends = torch.zeros_like(numbers[1:]), numbers[1:]
        measured = *ends, matches.targets.expand(count, -1, -1), weights
        kernel = robust and robust.widened(widening)
        problem = motion_only_problem(grid, *measured, numbers > 0, kernel)
        poses = torch.stack([T_source_world, *candidates])
        state = BundleState(poses, disparities.expand(count + 1, -1))
        state, _ = bundle_adjust(problem, state, POSE_ITERATIONS)
        candidates = list(state.T_camera_world[1:])
    return candidates[int(edge_costs(problem, state).argmin())]


def warp_disparities(grid: Grid, T_target_source: Tensor, disparities: Tensor) -> Tensor:  # (N,)
    """Warp the disparities (N,) of a source to the target.

    A cell that no point reaches takes the nearest cell's value; if points reach none, all cells
    take the median. Disparity zero is not warped.
    """
    warped = splat_disparities(grid, T_target_source, disparities).reshape(grid.shape)
    if not warped.any():
        return disparities[disparities > 0].median().expand(len(disparities)).clone()
    return filled_from_nearest(warped, warped == 0)


def splat_disparities(grid: Grid, T_target_source: Tensor, disparities: Tensor) -> Tensor:  # (N,)
    """Warp the disparities (N,) of a source; a cell takes the nearest of several, or 0 of none."""
    cells = T_target_source[None].to(disparities.dtype), disparities[None], grid.rays
    depth_ratio = scaled_points(*cells)[0, 2]
    positions, valid = reproject(*cells, grid.camera)
    cell, inside = grid.cells_at(positions[0])
    kept = valid[0] & inside
    warped, nearness = torch.zeros_like(disparities), disparities / depth_ratio
    return warped.scatter_reduce_(0, cell[kept], nearness[kept], "amax")


def filled_from_nearest(values: Tensor, empty: Tensor) -> Tensor:  # (h, w), (h, w) bool -> (N,)
    """Return values in which each empty cell has that of the nearest other one (scipy, CPU)."""
    cells = empty.cpu().numpy()
    nearest = ndimage.distance_transform_edt(cells, return_distances=False, return_indices=True)
    row, column = torch.from_numpy(nearest).to(values.device)
    return values[row, column].reshape(-1)
