"""The first geometry: poses and disparities of the warm-up keyframes, from flow alone.

A hypothesis is a guess of the first keyframe's disparities. It fixes the pose of the second
keyframe, whose disparities follow, and so on. Rotation and sideways translation look alike in a
small field of view, so a bad guess can end in a wrong minimum with small residuals. Therefore the
hypothesis of lowest cost after bundle adjustment is kept (safeguards/first_camera.py).
"""

from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import se3_interpolate, se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import start_pose, warp_disparities
from minislam.tracking.safeguards import motion_memory
from minislam.tracking.safeguards.first_camera import lowest_minimum
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.workers import Workers

SLOPE = 3.0  # largest disparity of a ground or of a slanted wall / smallest one [-]


def first_disparity_hypotheses(
    grid: Grid,
    known_disparities: Tensor,  # (K, N) of the depth prior, 0 where there is none
) -> list[tuple[Tensor, Tensor]]:
    """Return guesses (N,) of the first keyframe's disparities, each with its prior (K, N) or 0.

    They are the depth prior, if there is one, a wall facing the camera, a ground that is nearer
    below, and walls that are nearer on the left or on the right. The prior comes first, because the
    first of equal costs wins, as where the flow measures no depth.
    """
    camera = grid.camera
    right, below = (grid.pixels / grid.pixels.new_tensor([camera.width, camera.height]) - 0.5).T
    planes = [torch.ones_like(right), *(SLOPE**slope for slope in (below, -right, right))]
    guesses = [(plane, torch.zeros_like(known_disparities)) for plane in planes]
    first = known_disparities[0]
    known = first > 0
    if bool(known.any()):
        guesses.insert(0, (torch.where(known, first, first[known].median()), known_disparities))
    return guesses


def chain_state(
    grid: Grid,
    flow_to_next: list[FlowMatches],  # K - 1 matches, keyframe k to k + 1
    first_disparities: Tensor,  # (N,)
    known_disparities: Tensor,  # (K, N), 0 where there is no depth prior
    robust: RobustKernel | None,
) -> BundleState:
    """Return poses and disparities of K keyframes, each from its predecessor."""
    poses = [torch.eye(4, dtype=torch.float64, device=first_disparities.device)]
    disparities, ones = [first_disparities], torch.ones_like(first_disparities)
    for index, matches in enumerate(flow_to_next):
        last, of_last = poses[-1], disparities[-1]
        starts = [last]
        if index > 0:
            starts.append(se3_interpolate(poses[-2], last, 2.0))
        pose = start_pose(grid, matches, of_last, ones, last, starts, robust)
        warped = warp_disparities(grid, pose @ se3_inverse(last), of_last)
        known = known_disparities[index + 1]
        poses.append(pose)
        disparities.append(torch.where(known > 0, known, warped))
    return BundleState(torch.stack(poses), torch.stack(disparities))


def first_geometry(graph: KeyframeGraph, workers: Workers | None = None) -> None:
    """Estimate poses and disparities of all keyframes of the warm-up, and an unknown camera.

    Flow alone decides: a depth prior is one start of the search and gives the unit of length.
    """
    # The camera cannot be relocalised during the warm-up, so no flow is missing.
    flow_to_next = [matches for matches in graph.flow_to_next if matches is not None]
    keyframes = graph.keyframes
    keyframes.overlay = overlay = motion_memory.overlay_weights(flow_to_next, graph.grid)
    flow_to_next = [motion_memory.without_overlay(matches, overlay) for matches in flow_to_next]
    graph.flow_to_next = [*flow_to_next]
    for target in range(1, len(keyframes)):
        graph.match_composed(target)
    known = keyframes.prior_disparities

    def start(log_focal: float) -> list[BundleState]:
        grid = replace(graph.grid)
        grid.zoom(log_focal)
        guesses = first_disparity_hypotheses(grid, known)
        chains = [chain_state(grid, flow_to_next, *g, graph.robust) for g in guesses]
        return [replace(chain, log_focal=log_focal) for chain in chains]

    state, report = lowest_minimum(graph, start, workers)
    graph.grid.zoom(state.log_focal)
    graph.count_adjustment(report)
    keyframes.set_geometry(state.T_camera_world, state.disparities)
    keyframes.normalise_scale()
