"""The first geometry: poses and disparities of the warm-up keyframes, from flow alone.

A hypothesis is a guess of the first keyframe's disparities. It fixes the pose of the second
keyframe, whose disparities follow, and so on. Rotation and sideways translation look alike in a
small field of view, so a bad guess can end in a wrong minimum with small residuals. Therefore the
hypothesis of lowest cost after bundle adjustment is kept. An unknown focal length must be free in
that comparison: under a wrong one, depth that is inside out can fit better than the right one.
"""

import itertools
import math
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate, se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import BundleProblem, BundleState
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.pose_from_flow import ROBUST_WIDENING, start_pose, warp_disparities
from minislam.tracking.safeguards.first_depth import (
    FARTHEST,
    FOCAL_WORTH_SAVING,
    Found,
    most_plausible,
)
from minislam.tracking.safeguards.focal_length import fit_focal_length
from minislam.tracking.safeguards.motion_memory import inherit_motion_weight, overlay_weights
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.workers import Workers

HYPOTHESIS_ITERATIONS = 8  # Gauss-Newton steps per width before hypotheses are compared
WIDENINGS = [*ROBUST_WIDENING, 0.5, 0.25]  # of the robust weight, times the final width [-]
SLOPE = 3.0  # largest disparity of a ground or of a slanted wall / smallest one [-]
SAME_COST = 1e-3  # hypotheses that differ less have met in one minimum [-]
# Starts of an unknown focal length beside its guess: the search reaches 0.7 to 1.4 times the truth.
OTHER_FOCALS = (math.log(0.5), math.log(2.0))


def first_disparity_hypotheses(
    grid: Grid,
    known_disparities: Tensor,  # (K, N) of the depth prior, 0 where there is none
) -> list[tuple[Tensor, Tensor]]:
    """Return guesses (N,) of the first keyframe's disparities, each with what it knows (K, N).

    They are the depth prior, if there is one, a wall before the camera, a ground that is nearer
    below, and walls that are nearer on the left or on the right. The prior comes first, because of
    equal costs the first wins, as where no flow tells any depth.
    """
    camera = grid.camera
    right, below = (grid.pixels / grid.pixels.new_tensor([camera.width, camera.height]) - 0.5).T
    alone = [torch.ones_like(right), *(SLOPE**slope for slope in (below, -right, right))]
    guesses = [(disparities, torch.zeros_like(known_disparities)) for disparities in alone]
    known = (first := known_disparities[0]) > 0
    if bool(known.any()):
        guesses.insert(0, (torch.where(known, first, first[known].median()), known_disparities))
    return guesses


def chain_state(
    grid: Grid,
    flow_to_next: list[FlowMatches],  # K - 1 matches, keyframe k to k + 1
    first_disparities: Tensor,  # (N,)
    known_disparities: Tensor,  # (K, N), 0 where there is no depth prior
    robust: RobustKernel | None,
    first_weights: Tensor | None = None,  # (N,) in [0, 1] of the first keyframe; None: ones
) -> BundleState:
    """Return poses and disparities of K keyframes, each from its predecessor."""
    poses = [torch.eye(4, dtype=torch.float64, device=first_disparities.device)]
    disparities = [first_disparities]
    weights = torch.ones_like(first_disparities) if first_weights is None else first_weights
    for index, matches in enumerate(flow_to_next):
        last, of_last = poses[-1], disparities[-1]
        starts = [last]
        if index > 0:
            starts.append(se3_interpolate(poses[-2], last, 2.0))
        pose = start_pose(grid, matches, of_last, weights, last, starts, robust)
        weights = inherit_motion_weight(grid, matches, weights)
        warped = warp_disparities(grid, pose @ se3_inverse(last), of_last)
        known = known_disparities[index + 1]
        poses.append(pose)
        disparities.append(torch.where(known > 0, known, warped))
    return BundleState(torch.stack(poses), torch.stack(disparities))


def minima(
    problem: BundleProblem,
    states: list[BundleState],
    workers: Workers | None = None,  # adjust side by side
) -> list[Found]:
    """Adjust every hypothesis on the same measurements and return where they end, each place once.

    A wide robust weight lets a bad guess leave its wrong minimum, but under the widest one a large
    dynamic object may outvote the room. So every hypothesis starts from the two widest. Costs are
    compared under a narrow one, which a compromise between room and dynamic object does not fit.
    """
    starts = [WIDENINGS, WIDENINGS[1:]] if problem.robust else [[1.0]]
    calls = [(problem, *pair, HYPOTHESIS_ITERATIONS) for pair in itertools.product(states, starts)]
    found: list[Found] = []
    for state, report in (workers or Workers()).map(adjust_narrowing, calls):
        cost = report.cost_after
        if all(abs(cost - other.cost_after) > SAME_COST * cost for _, other in found):
            found.append((state, report))
    return found


def first_geometry(graph: KeyframeGraph, workers: Workers | None = None) -> None:
    """Estimate poses and disparities of all keyframes of the warm-up, and an unknown focal length.

    Flow alone decides: a depth prior is one start of the search and gives the unit of length. The
    focal length stays as guessed if the motion does not tell it.
    """
    # The camera cannot be relocalised during the warm-up, so no flow is missing.
    flow_to_next = [matches for matches in graph.flow_to_next if matches is not None]
    workers, keyframes = workers or Workers(), graph.keyframes
    keyframes.overlay = overlay_weights(flow_to_next, graph.grid)
    for target in range(1, len(keyframes)):
        graph.match_composed(target)
    problem = bundle_problem(graph, range(len(graph.links)), first_free=0, lambda_prior=0.0)

    def start(log_focal: float) -> list[Found]:
        grid = replace(graph.grid)
        grid.zoom(log_focal)
        known, weights = keyframes.prior_disparities, keyframes.cell_weights[0]
        guesses = first_disparity_hypotheses(grid, known)
        chains = [chain_state(grid, flow_to_next, *g, graph.robust, weights) for g in guesses]
        return minima(problem, [replace(chain, log_focal=log_focal) for chain in chains], workers)

    held = start(0.0)
    state, report = min(held, key=lambda result: result[1].cost_after)
    if graph.seeks_focal:
        free = replace(problem, free_focal=True)
        found = [*held, *(result for other in OTHER_FOCALS for result in start(other))]
        calls = [(free, state, WIDENINGS[1:], HYPOTHESIS_ITERATIONS) for state, _ in found]
        freed = workers.map(adjust_narrowing, calls)
        chosen = most_plausible(graph.grid, keyframes.prior_disparities, freed)
        best, at_guess = freed[chosen], held[chosen] if chosen < len(held) else (state, report)
        fit, fitted = fit_focal_length(problem, at_guess[0], workers, best[0])
        if fit.factor is not None:
            graph.focal_is_free = True
            state, report = adjust_narrowing(free, fitted, WIDENINGS[2:], HYPOTHESIS_ITERATIONS)
        elif abs(best[0].log_focal) <= FARTHEST and (
            best[1].cost_after < (1 - FOCAL_WORTH_SAVING) * report.cost_after
        ):
            graph.focal_is_free, (state, report) = True, best
    graph.grid.zoom(state.log_focal)
    graph.count_adjustment(report)
    keyframes.set_geometry(state.T_camera_world, state.disparities)
    keyframes.normalise_scale()
