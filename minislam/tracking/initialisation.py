"""The first geometry: poses and disparities of the warm-up keyframes, from flow alone.

A hypothesis is a guess of the first keyframe's disparities. It fixes the pose of the second
keyframe, whose disparities follow, and so on. Rotation and sideways translation look alike in a
small field of view, so a bad guess can end in a wrong minimum with small residuals. Therefore the
hypothesis of lowest cost after bundle adjustment is kept.
"""

import itertools
import math
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate, se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import BundleProblem, BundleReport, BundleState
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.pose_from_flow import ROBUST_WIDENING, start_pose, warp_disparities
from minislam.tracking.safeguards.first_depth import essential_disparities
from minislam.tracking.safeguards.focal_length import seek_focal_length
from minislam.tracking.safeguards.motion_memory import inherit_motion_weight, overlay_weights
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.workers import Workers

HYPOTHESIS_ITERATIONS = 8  # Gauss-Newton steps per width before hypotheses are compared
ROBUST_NARROWING = (0.5, 0.25)  # [-], times the final width
# Starts of an unknown focal length beside its guess: the search reaches 0.7 to 1.4 times the truth.
OTHER_FOCALS = (math.log(0.5), math.log(2.0))
# Of 21 clips, two whose guess was far off saved 12 and 14 % of the cost; no other one 3 %. [-]
FOCAL_WORTH_SAVING = 0.08


def first_disparity_hypotheses(
    grid: Grid,
    known_disparities: Tensor,  # (K, N) of the depth prior, 0 where there is none
    from_first: list[tuple[Tensor, Tensor]],  # targets [px] and confidences (N, 2) to followers
) -> list[tuple[Tensor, Tensor]]:
    """Return guesses (N,) of the first keyframe's disparities, each with what it knows (K, N).

    They are the depth prior, if there is one, a wall, and essential matrices. The prior comes
    first, because of equal costs the first wins, as where no flow tells any depth.
    """
    triangulated = [essential_disparities(grid, *measured) for measured in from_first]
    alone = [torch.ones_like(known_disparities[0]), *(d for d in triangulated if d is not None)]
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


def best_hypothesis(
    problem: BundleProblem,
    states: list[BundleState],
    workers: Workers | None = None,  # adjust side by side
) -> tuple[BundleState, BundleReport]:
    """Adjust every hypothesis on the same measurements and return the one of lowest cost.

    A wide robust weight lets a bad guess leave its wrong minimum, but under the widest one a large
    dynamic object may outvote the room. So every hypothesis starts from the two widest. Costs are
    compared under a narrow one, which a compromise between room and dynamic object does not fit.
    """
    widenings = [*ROBUST_WIDENING, *ROBUST_NARROWING]
    starts = [widenings, widenings[1:]] if problem.robust else [[1.0]]
    calls = [(problem, *pair, HYPOTHESIS_ITERATIONS) for pair in itertools.product(states, starts)]
    results = (workers or Workers()).map(adjust_narrowing, calls)
    return min(results, key=lambda result: result[1].cost_after)


def first_geometry(graph: KeyframeGraph, workers: Workers | None = None) -> None:
    """Estimate poses and disparities of all keyframes of the warm-up, and an unknown focal length.

    Flow alone decides: a depth prior is one start of the search and gives the unit of length.
    """
    # The camera cannot be relocalised during the warm-up, so no flow is missing.
    flow_to_next = [matches for matches in graph.flow_to_next if matches is not None]
    keyframes = graph.keyframes
    keyframes.overlay = overlay_weights(flow_to_next, graph.grid)
    for target in range(1, len(keyframes)):
        graph.match_composed(target)
    problem = bundle_problem(graph, range(len(graph.links)), first_free=0, lambda_prior=0.0)

    def start(log_focal: float) -> tuple[BundleState, BundleReport]:
        grid = replace(graph.grid)
        grid.zoom(log_focal)
        known, weights = keyframes.prior_disparities, keyframes.cell_weights[0]
        guesses = first_disparity_hypotheses(grid, known, graph.links.flow_from(0))
        chains = [chain_state(grid, flow_to_next, *g, graph.robust, weights) for g in guesses]
        states = [replace(chain, log_focal=log_focal) for chain in chains]
        return best_hypothesis(problem, states, workers)

    state, report = start(0.0)
    if graph.seeks_focal:
        other = min((start(s) for s in OTHER_FOCALS), key=lambda found: found[1].cost_after)
        graph.focal_is_free = other[1].cost_after < (1 - FOCAL_WORTH_SAVING) * report.cost_after
        state, report = other if graph.focal_is_free else (state, report)
    graph.grid.zoom(state.log_focal)
    graph.count_adjustment(report)
    keyframes.set_geometry(state.T_camera_world, state.disparities)
    keyframes.normalise_scale()
    seek_focal_length(graph)
