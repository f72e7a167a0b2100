"""A camera that stands, or only turns: no depth is measured, so its poses are pure rotations."""

import math
from dataclasses import replace
from statistics import fmean, median

import torch

from minislam.tracking.bundle_adjustment import bundle_adjust, residuals
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.pose_from_flow import POSE_ITERATIONS, ROBUST_WIDENING, motion_only_problem
from minislam.tracking.reprojection import lengths, parallax
from minislam.tracking.safeguards.robust import weighted_median

TURN_WIDENING = (16.0, 8.0)  # of the robust weight of a turn: narrower, it follows what is far
MOST_PAIRS = 100  # of neighbouring keyframes that are tested for parallax


def flow_beyond_turns(graph: KeyframeGraph) -> float | None:  # px of a 320x240 image
    """Return the flow between neighbouring keyframes that no rotation of the camera explains.

    A rotation moves all points as if they were infinitely far away. What the best one leaves, in
    the median, measures depth, whatever parallax the poses claim. A focal length that is sought and
    not yet found is free (diary/focal_length.md). None: no edge has any weight.
    """
    grid, edges, keyframes = graph.grid, graph.edges, graph.keyframes
    pairs = [p for p, (source, target) in enumerate(edges.ends) if target == source + 1]
    if not pairs:
        return None
    pairs = pairs[:: math.ceil(len(pairs) / MOST_PAIRS)]
    weights = [edges.confidences[p] * keyframes.cell_weights[edges.ends[p][0]] for p in pairs]
    numbers = torch.arange(len(pairs) + 1, device=grid.rays.device)
    ends = torch.zeros_like(numbers[1:]), numbers[1:]  # without translation sources share a pose
    measured = torch.stack([edges.targets[p] for p in pairs]), torch.stack(weights)
    problem = motion_only_problem(grid, *ends, *measured, numbers > 0, None)
    problem = replace(problem, free_focal=graph.seeks_focal and not graph.focal_is_free)
    poses = torch.eye(4, dtype=torch.float64, device=grid.rays.device).repeat(len(numbers), 1, 1)
    turned = BundleState(poses, grid.rays.new_zeros(len(numbers), len(grid.rays)))
    kernels = [graph.robust.widened(width) for width in TURN_WIDENING] if graph.robust else []
    for kernel in (None, *kernels):
        turned, _ = bundle_adjust(replace(problem, robust=kernel), turned, POSE_ITERATIONS)
    left = lengths(residuals(problem, turned)[0])
    medians = [weighted_median(*pair) for pair in zip(left, problem.weights[:, 0], strict=True)]
    known = [found for found in medians if found is not None]
    return median(known) / graph.pixel_scale if known else None


def fraction_at_rest(graph: KeyframeGraph) -> float:
    """Return the fraction of the keyframes whose poses claim hardly any parallax [-]."""
    return fmean(_rests(graph, keyframe) for keyframe in range(len(graph.keyframes)))


def _rests(graph: KeyframeGraph, keyframe: int) -> bool:
    """Tell whether most cells have too little parallax in every edge whose target sees them."""
    targets = [target for source, target in graph.edges.ends if source == keyframe]
    if not targets:
        return True
    shift, positions, valid = parallax(*graph.geometry([keyframe] * len(targets), targets))
    largest = (shift * (valid & graph.grid.camera.contains(positions.mT))).amax(0)
    most = weighted_median(largest, graph.keyframes.cell_weights[keyframe])
    return most is None or most < graph.least_parallax


def adjust_turns(graph: KeyframeGraph) -> None:
    """Adjust the rotations of the keyframes alone: all that they see is infinitely far away."""
    keyframes, problem = graph.keyframes, bundle_problem(graph, range(len(graph.edges)))
    problem = replace(problem, free_disparities=torch.zeros_like(problem.free_disparities))
    poses = keyframes.T_camera_world.clone()
    poses[:, :3, 3] = 0
    state = replace(graph.state, T_camera_world=poses, disparities=0 * keyframes.disparities)
    state, report = adjust_narrowing(problem, state, [*ROBUST_WIDENING], POSE_ITERATIONS)
    graph.count_adjustment(report)
    if report.converged:
        keyframes.set_geometry(state.T_camera_world, state.disparities)
