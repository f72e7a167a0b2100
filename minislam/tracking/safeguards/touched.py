"""A local adjustment without the keyframes that it neither moves nor sees.

So it costs the same however many there are.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleReport,
    BundleState,
    bundle_adjust,
)

FEW_KEYFRAMES = 100  # so few are not worth a selection
_OF_KEYFRAMES = (
    "prior_disparities", "prior_weights", "free_poses", "free_disparities", "disparity_damping",
)  # fmt: skip
_OF_CELLS = "targets", "weights", "prior_disparities", "prior_weights", "disparity_damping"


def adjust_touched(
    problem: BundleProblem, state: BundleState, iterations: int
) -> tuple[BundleState, BundleReport]:
    """Return what `bundle_adjust` does, from the keyframes that count alone."""
    rows = touched_rows(problem)
    found, report = bundle_adjust(*of_rows(problem, state, rows), iterations)
    poses, disparities = state.T_camera_world.clone(), state.disparities.clone()
    poses[rows], disparities[rows] = found.T_camera_world, found.disparities
    return replace(found, T_camera_world=poses, disparities=disparities), report


def touched_rows(problem: BundleProblem) -> Tensor:  # (K',) keyframe index
    """Return the keyframes that a problem moves or has an edge to; all, if there are few."""
    is_touched = problem.free_disparities.clone()
    is_touched[problem.edges_source] = is_touched[problem.edges_target] = True
    return (is_touched | (len(is_touched) <= FEW_KEYFRAMES)).nonzero()[:, 0]


def of_rows(
    problem: BundleProblem, state: BundleState, rows: Tensor
) -> tuple[BundleProblem, BundleState]:
    """Return problem and state of some keyframes (K',) alone; all edges must be among them."""
    values: dict[str, Any] = {name: getattr(problem, name) for name in _OF_KEYFRAMES}
    values = {name: None if value is None else value[rows] for name, value in values.items()}
    for name in ("edges_source", "edges_target"):
        values[name] = torch.searchsorted(rows, getattr(problem, name).contiguous())
    problem = replace(problem, **values)
    poses, disparities = state.T_camera_world[rows], state.disparities[rows]
    return problem, replace(state, T_camera_world=poses, disparities=disparities)


def of_cells(
    problem: BundleProblem, state: BundleState, cells: Tensor
) -> tuple[BundleProblem, BundleState]:
    """Return problem and state of some cells (N',) of the grid alone."""
    values: dict[str, Any] = {name: getattr(problem, name) for name in _OF_CELLS}
    values = {name: None if value is None else value[..., cells] for name, value in values.items()}
    problem = replace(problem, rays=problem.rays[cells], **values)
    return problem, replace(state, disparities=state.disparities[:, cells])
