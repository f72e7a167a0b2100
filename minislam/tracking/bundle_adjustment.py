"""Dense bundle adjustment, Eq. (5): poses and disparities from optical flow.

    sum_edges || p~_ij - proj(T_j T_i^-1, d_i) ||^2_(Sigma_ij / beta_i^2)
        + sum_i lambda_4 M_i (d_i - 1 / D~_i)^2

Gauss-Newton with Levenberg-Marquardt damping; the slow twin is reference.py. Disparities are
marginalised (schur.py), which leaves 6 unknowns per free pose.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import se3_adjoint, se3_exp, se3_normalised
from minislam.state.threads import side_by_side
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.reprojection import Linearisation, relative_transforms
from minislam.tracking.safeguards.focal_column import reproject_with_focal, within_reach
from minislam.tracking.safeguards.parts import SourceBlocks, in_parts, joined
from minislam.tracking.safeguards.robust import edge_losses
from minislam.tracking.safeguards.rolling_shutter import with_shifts
from minislam.tracking.schur import NormalEquations, marginalised, source_blocks

MIN_DISPARITY = 1e-5  # 1/world unit: keeps points in front of the camera, as the official code
DISPARITY_DAMPING = 1e-2  # fraction of the mean diagonal C that is added to all of it [-]
MIN_RAISED_DAMPING = 1e-6  # relative; an undamped solve that fails is tried again with this
LEAST_SAVING = 1e-6  # of the cost: a step that saves no more is the last; 1e-9 gave the same poses
MAX_DAMPING = 1e6  # relative; a step damped more than this would not move anything


@dataclass(frozen=True)
class BundleReport:
    """What a bundle adjustment did."""

    converged: bool  # False only if the normal equations stayed singular, whatever the damping
    cost_before: float  # px^2
    cost_after: float  # px^2, never larger than cost_before
    iterations: int  # accepted steps
    damping: float  # at the end


@dataclass(frozen=True)
class _WeightedPart:
    """Some edges, linearised about a state and weighted."""

    edges: Tensor  # (E,) positions in the whole problem
    costs: Tensor  # (E,) float64 px^2
    residual: Tensor  # (E, 2, N) px
    weight: Tensor  # (E, 2, N), the robust one included
    reprojection: Linearisation  # J_target is (E, 6 + G, 2, N), G free camera parameters
    transforms: Tensor  # (E, 4, 4) T_target_source


def bundle_adjust(
    problem: BundleProblem,
    state: BundleState,
    iterations: int,
    damping: float = 1e-4,  # relative (Levenberg-Marquardt), raised on failure
    absolute_damping: float = 1e-6,  # px^2 per squared unit step: holds unobservable directions
) -> tuple[BundleState, BundleReport]:
    """Minimise over the free poses and disparities; return the new state with a report.

    A step that fails or raises the cost is discarded and tried again with ten times the damping.
    If no step helps, the state is returned unchanged. Eq. (5).
    """
    equations = normal_equations(problem, state)
    cost_before = cost = equations.cost
    accepted, level = 0, damping
    converged = True
    while accepted < iterations:
        candidate = _damped_step(problem, state, equations, level, absolute_damping)
        next_equations, next_cost = equations, math.inf
        if candidate is not None:
            is_last = accepted + 1 == iterations  # then the cost is enough
            next_equations = equations if is_last else normal_equations(problem, candidate)
            next_cost = _cost(problem, candidate) if is_last else next_equations.cost
        if candidate is not None and next_cost <= cost:
            saved = cost - next_cost
            state, cost, equations = candidate, next_cost, next_equations
            accepted, level = accepted + 1, max(level / 10, damping)
            if saved <= LEAST_SAVING * cost:
                break
        else:
            level = max(10 * level, MIN_RAISED_DAMPING)
            if level > MAX_DAMPING:
                # At the minimum no step lowers the cost: that is convergence, not failure.
                converged = candidate is not None
                break
    return state, BundleReport(converged, cost_before, cost, accepted, level)


def residuals(problem: BundleProblem, state: BundleState) -> tuple[Tensor, Tensor]:
    """Return the residuals p~ - p (E, 2, N) [px] and the weights (E, 2, N), robust one included."""
    parts = _weighted_parts(problem, state)
    residual, weight = joined((at.edges, at.residual, at.weight) for at in parts)
    return residual, weight


def _weighted_parts(problem: BundleProblem, state: BundleState) -> Iterator[_WeightedPart]:
    """Linearise and weight the edges, part by part."""
    return side_by_side(partial(_weighted_part, state), in_parts(problem))


def _weighted_part(state: BundleState, edges: Tensor, part: BundleProblem) -> _WeightedPart:
    source, dtype = part.edges_source, part.targets.dtype
    transforms = relative_transforms(state.T_camera_world, source, part.edges_target)
    view = part.rays, part.camera, state.log_focal, part.free_focal
    reprojection = reproject_with_focal(transforms.to(dtype), state.disparities[source], *view)
    reprojection = with_shifts(reprojection, part.shift_columns, state.shifts)
    residual = part.targets - reprojection.positions
    weight = part.weights * reprojection.valid[:, None]
    if part.robust is not None:
        weight = weight * part.robust.weight(residual.square().sum(1, keepdim=True))
    # A point behind the target, or too near, counts as a residual of the image's width in u and
    # v. Were it left out, the cheapest camera would be one that looks away from all points.
    counted = torch.where(reprojection.valid[:, None], residual, float(part.camera.width))
    costs = edge_losses(part.weights, counted, part.robust)
    return _WeightedPart(edges, costs, residual, weight, reprojection, transforms)


def edge_costs(problem: BundleProblem, state: BundleState) -> Tensor:  # (E,) float64 px^2
    """Return the reprojection cost of each edge, the robust loss included."""
    return joined((at.edges, at.costs) for at in _weighted_parts(problem, state))[0]


def _cost(problem: BundleProblem, state: BundleState, costs: list[Tensor] | None = None) -> float:
    """Return the cost [px^2] of Eq. (5), from the costs of the edges if these are computed."""
    costs = costs or [at.costs for at in _weighted_parts(problem, state)]
    difference = state.disparities - problem.prior_disparities
    prior_cost = (problem.prior_weights * difference.square()).sum(dtype=torch.float64)
    return float(torch.cat(costs).sum() + prior_cost)


def normal_equations(problem: BundleProblem, state: BundleState) -> NormalEquations:
    """Return the normal equations of Eq. (5) about a state: blocks of edges and of disparities."""
    C = problem.prior_weights * problem.free_disparities[:, None]
    s = C * (problem.prior_disparities - state.disparities)

    def of_part(edges: Tensor, part: BundleProblem) -> tuple[Any, ...]:
        """Return costs, blocks and couplings; add to the rows of C and s that no other part has."""
        at, source = _weighted_part(state, edges, part), part.edges_source
        residual, weight, J = at.residual, at.weight, at.reprojection.J_target
        weighted_J = (J * weight[:, None]).flatten(2)
        A = (weighted_J @ J.flatten(2).mT).double()  # (E, 6 + G, 6 + G)
        b = (weighted_J @ residual.flatten(1)[..., None]).squeeze(-1).double()  # (E, 6 + G)
        blocks = edges, A, b, (adjoint := se3_adjoint(at.transforms))
        free = problem.free_disparities[source].to(J.dtype)
        if not free.any():
            return at.costs, blocks, []
        J_disparity = at.reprojection.J_disparity * free[:, None, None]
        weighted_Jd = weight * J_disparity
        E_target = J[:, :, 0] * weighted_Jd[:, None, 0] + J[:, :, 1] * weighted_Jd[:, None, 1]
        E_source = -adjoint.mT.to(J.dtype) @ E_target[:, :6]
        C.index_add_(0, source, (weighted_Jd * J_disparity).sum(1))
        s.index_add_(0, source, (weighted_Jd * residual).sum(1))
        return at.costs, blocks, source_blocks(part, E_target, E_source)

    costs, rows, couplings = [], [], SourceBlocks(problem)
    for of_edges, blocks, of_sources in side_by_side(of_part, in_parts(problem)):
        costs.append(of_edges)
        rows.append(blocks)
        couplings.add(of_sources)
    A, b, adjoints = joined(rows)
    return NormalEquations(_cost(problem, state, costs), A, b, adjoints, C, s, couplings)


def _damped_step(
    problem: BundleProblem,
    state: BundleState,
    equations: NormalEquations,
    damping: float,
    absolute_damping: float,
) -> BundleState | None:
    """Solve the damped normal equations; return the new state, or None if they are singular."""
    C = equations.disparity_diagonal
    observed = C > 0
    # Without this, cells that the flow hardly constrains would take steps far too long.
    added = DISPARITY_DAMPING * C.sum() / observed.sum().clamp_min(1)
    if problem.disparity_damping is not None:  # learned, for cells without a prior
        added = problem.disparity_damping * (problem.prior_weights == 0)
    C = C * (1 + damping) + added
    inverse_C = torch.where(observed, C, torch.ones_like(C)).reciprocal() * observed
    S, b = marginalised(problem, equations, inverse_C)
    S.diagonal().mul_(1 + damping).add_(absolute_damping)
    factor, failure = torch.linalg.cholesky_ex(S)
    # Not `cholesky_solve`, which copies the factor: with hundreds of keyframes it has 100 MB.
    xi = torch.linalg.solve_triangular(factor, b[:, None], upper=False)
    xi = torch.linalg.solve_triangular(factor.mT, xi, upper=True).squeeze(1)
    if failure | ~torch.isfinite(xi).all():
        return None

    poses = state.T_camera_world.clone()
    moving = poses[problem.free_poses]
    twists, common = xi[: 6 * len(moving)], xi[6 * len(moving) :].tolist()
    poses[problem.free_poses] = se3_normalised(se3_exp(twists.reshape(-1, 6)) @ moving)
    step = equations.disparity_gradient.clone()
    for source, rows, E in equations.source_blocks:
        step[source] -= xi[rows].to(E.dtype) @ E
    disparities = (state.disparities + inverse_C * step).clamp_min(MIN_DISPARITY)
    disparities = torch.where(problem.free_disparities[:, None], disparities, state.disparities)
    zoom = common.pop(0) if problem.free_focal else 0.0
    further = common or (0.0, 0.0)
    shifts = state.shifts[0] + further[0], state.shifts[1] + further[1]
    return BundleState(poses, disparities, within_reach(state.log_focal + zoom), shifts)
