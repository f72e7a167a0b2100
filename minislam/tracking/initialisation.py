"""The first geometry: poses and disparities of the warm-up keyframes, from flow alone.

A hypothesis is a guess of the first keyframe's disparities. It fixes the pose of the second
keyframe, whose disparities follow, and so on along the chain. Rotation and sideways translation
look alike in a small field of view, so a bad guess can settle in a wrong basin with small
residuals: several hypotheses are carried through the same bundle adjustment and compared.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from minislam.geometry import se3_interpolate, se3_inverse
from minislam.geometry.distortion import camera_matrix
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleState,
    bundle_adjust,
    edge_costs,
    motion_only_adjust,
)
from minislam.tracking.grid import Grid
from minislam.tracking.motion_memory import inherited_trust, updated_trust
from minislam.tracking.reprojection import splat_disparities
from minislam.tracking.robust import RobustKernel

ESSENTIAL_THRESHOLD = 0.7  # px, RANSAC inlier distance to the epipolar line
POSE_ITERATIONS = 6  # Gauss-Newton steps per width of the robust weight
# A start that is off by 10 degrees is off by 50 px, where a narrow robust weight sees only
# outliers: the weight is narrowed step by step.
ROBUST_WIDENING = (16.0, 4.0, 1.0)  # [-], times the final width
MIN_CELLS_FOR_ESSENTIAL = 40  # confident cells; five define the matrix, noise wants many more
HYPOTHESIS_ITERATIONS = 12  # Gauss-Newton steps per width before hypotheses are compared
DISPARITY_SPREAD = 20.0  # largest ratio of a triangulated disparity to the median, both ways


def compose_matches(first: FlowMatches, second: FlowMatches, grid: Grid) -> FlowMatches:
    """Return the matches a -> c from matches a -> b and b -> c (E = 1 each)."""
    middle = first.targets.mT
    flow = second.targets.mT - grid.pixels
    targets = first.targets + grid.sample(flow, middle).mT
    confidences = first.confidences * grid.sample(second.confidences.mT, middle).mT
    return FlowMatches(targets, confidences, first.matched_ratios * second.matched_ratios)


def start_pose(
    grid: Grid,
    matches: FlowMatches,  # E = 1, source to target
    disparities: Tensor,  # (N,) of the source
    trust: Tensor,  # (N,) in [0, 1] of the source cells
    T_source_world: Tensor,  # (4, 4)
    starts: list[Tensor],  # candidates (4, 4) for T_target_world
    robust: RobustKernel | None,
) -> Tensor:
    """Return T_target_world (4, 4) that explains the flow best.

    Gauss-Newton on six unknowns from several starts, each with the robust weight narrowed from
    wide, from less wide and not at all; the cheapest end is kept. From far only a wide weight
    finds the way, but while it is wide, a near mover with long residuals pulls the pose to itself,
    and what a narrow weight then finds there costs more than the truth. All of them are solved
    side by side: as poses of one problem that share nothing but the source.
    """
    candidates: list[Tensor] = []
    for widening in ROBUST_WIDENING if robust else (1.0,):
        candidates += starts
        count = len(candidates)
        empty = torch.zeros(count + 1, len(grid.rays))
        problem = BundleProblem(
            camera=grid.camera,
            rays=grid.rays,
            edges_source=torch.zeros(count, dtype=torch.long),
            edges_target=torch.arange(1, count + 1),
            targets=matches.targets.expand(count, -1, -1),
            weights=(matches.confidences * trust).expand(count, -1, -1),
            prior_disparities=empty,
            prior_weights=empty,
            free_poses=torch.arange(count + 1) > 0,
            free_disparities=torch.zeros(count + 1, dtype=torch.bool),
            robust=robust and robust.widened(widening),
        )
        poses = torch.stack([T_source_world, *candidates])
        state = BundleState(poses, disparities.expand(count + 1, -1))
        state, _ = motion_only_adjust(problem, state, POSE_ITERATIONS)
        candidates = list(state.T_camera_world[1:])
    return candidates[int(edge_costs(problem, state).argmin())]


def carry_disparities(
    grid: Grid, T_target_source: Tensor, disparities: Tensor
) -> Tensor:  # (N,) of the target
    """Return disparities of a new keyframe from those of the last; holes take the nearest cell."""
    carried = splat_disparities(
        T_target_source, disparities, grid.rays, grid.camera, grid.shape, grid.stride
    ).reshape(grid.shape)
    empty = carried.numpy() == 0
    if empty.all():
        return disparities.median().expand(len(disparities)).clone()
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return carried[torch.from_numpy(nearest[0]), torch.from_numpy(nearest[1])].reshape(-1)


def triangulate(
    grid: Grid,
    T_target_source: Tensor,  # (4, 4)
    targets: Tensor,  # (N, 2) px
    confident: Tensor,  # (N,) bool
) -> Tensor:  # (N,)
    """Return the disparities that best explain matches under a known motion.

    With the matched ray (a, b, 1), (R rho + d t) must be parallel to it: two equations that are
    linear in d, solved by least squares.
    """
    rotated = grid.rays @ T_target_source[:3, :3].T.to(grid.rays.dtype)
    t = T_target_source[:3, 3].to(grid.rays.dtype)
    seen = grid.camera.rays(targets)[:, :2]
    factor = t[:2] - seen * t[2]
    value = seen * rotated[:, 2:] - rotated[:, :2]
    disparities = (factor * value).sum(1) / factor.square().sum(1).clamp_min(1e-12)
    usable = confident & (disparities > 0)
    if not usable.any():
        return torch.ones_like(disparities)
    typical = disparities[usable].median()
    usable &= disparities < DISPARITY_SPREAD * typical
    usable &= disparities > typical / DISPARITY_SPREAD
    return torch.where(usable, disparities, typical) / typical


def essential_disparities(
    grid: Grid,
    targets: Tensor,  # (N, 2) px
    confidences: Tensor,  # (N, 2)
) -> Tensor | None:  # (N,)
    """Return disparities of the source from an essential matrix, median 1, or None."""
    confident = confidences[:, 0] > 0.5
    if int(confident.sum()) < MIN_CELLS_FOR_ESSENTIAL:
        return None
    source = grid.pixels[confident].double().numpy()
    target = targets[confident].double().numpy()
    matrix = camera_matrix(grid.camera)
    cv2.setRNGSeed(0)
    essential, inliers = cv2.findEssentialMat(
        source, target, matrix, cv2.RANSAC, 0.999, ESSENTIAL_THRESHOLD
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, source, target, matrix, mask=inliers)
    T_target_source = np.eye(4)
    T_target_source[:3, :3], T_target_source[:3, 3] = rotation, translation[:, 0]
    return triangulate(grid, torch.from_numpy(T_target_source), targets, confident)


def first_disparity_hypotheses(
    grid: Grid,
    from_first: list[tuple[Tensor, Tensor]],  # targets [px] and confidences (N, 2) to followers
) -> Iterator[Tensor]:
    """Yield guesses (N,) of the first keyframe's disparities: a wall, then essential matrices."""
    yield torch.ones(len(grid.rays))
    for targets, confidences in from_first:
        disparities = essential_disparities(grid, targets, confidences)
        if disparities is not None:
            yield disparities


def chain_state(
    grid: Grid,
    chain: list[FlowMatches],  # K - 1 matches, keyframe k to k + 1
    first_disparities: Tensor,  # (N,)
    known_disparities: Tensor,  # (K, N), 0 where there is no depth prior
    robust: RobustKernel | None,
    memory_scale: float | None,  # px; None: motion is not remembered
) -> tuple[BundleState, Tensor]:  # and the trust (K, N) in the cells
    """Return poses and disparities of K keyframes, each from its predecessor."""
    identity = torch.eye(4, dtype=torch.float64)
    poses, disparities = [identity], [first_disparities]
    trust = [torch.ones_like(first_disparities)]
    for index, matches in enumerate(chain):
        last, depths = poses[-1], disparities[-1]
        starts = [last]
        if index > 0:
            starts.append(se3_interpolate(poses[-2], last, 2.0))
        pose = start_pose(grid, matches, depths, trust[-1], last, starts, robust)
        motion = pose @ se3_inverse(last)
        if memory_scale is not None:
            trust[-1] = updated_trust(grid, matches, depths, motion, trust[-1], memory_scale)
        trust.append(inherited_trust(grid, matches, trust[-1]))
        carried = carry_disparities(grid, motion, depths)
        known = known_disparities[index + 1]
        poses.append(pose)
        disparities.append(torch.where(known > 0, known, carried))
    return BundleState(torch.stack(poses), torch.stack(disparities)), torch.stack(trust)


def best_hypothesis(problem: BundleProblem, states: list[BundleState]) -> BundleState:
    """Adjust every hypothesis on the same measurements and return the cheapest.

    Comparing is safe where a threshold is not: a wrong basin can have small residuals too, but
    on the same measurements the right one has smaller ones. A guess that is far off only leaves
    its basin while the robust weight is wide; a depth prior makes one hypothesis, which is near.
    """
    robust = problem.robust
    widenings = ROBUST_WIDENING if robust and len(states) > 1 else (1.0,)
    ends = []
    for state in states:
        for widening in widenings:
            problem = replace(problem, robust=robust and robust.widened(widening))
            state, report = bundle_adjust(problem, state, HYPOTHESIS_ITERATIONS)
        ends.append((report.cost_after, state))
    return min(ends, key=lambda end: end[0])[1]
