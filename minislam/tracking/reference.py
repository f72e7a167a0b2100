"""One Gauss-Newton step of Eq. (5) as a textbook writes it: dense, differentiated by autograd.

Every pose and every disparity is an unknown of one large system; nothing is marginalised and no
derivative is written by hand. Read it first. It is slow; its fast twin, bundle_adjustment.py, is
tested against it. Neither focal length nor readout is an unknown here, and no damping is learned.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse, transform_points
from minislam.tracking.bundle_adjustment import DISPARITY_DAMPING, MIN_DISPARITY
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.reprojection import MIN_DEPTH_RATIO


@dataclass(frozen=True)
class DenseNormalEquations:
    """(J^T W J) x = J^T W r, with x = the 6 P pose unknowns, then the D disparity unknowns."""

    matrix: Tensor  # (6 P + D, 6 P + D)
    vector: Tensor  # (6 P + D,)
    pose_unknowns: int  # 6 P


def predicted_positions(problem: BundleProblem, state: BundleState) -> tuple[Tensor, Tensor]:
    """Return where the source cells are seen, (E, 2, N) px, and whether validly, (E, N) bool."""
    positions, valid = [], []
    for source, target in zip(problem.edges_source, problem.edges_target, strict=True):
        disparities = state.disparities[source]
        T_target_source = state.T_camera_world[target] @ se3_inverse(state.T_camera_world[source])
        points_source = problem.rays / disparities[:, None]
        points_target = transform_points(T_target_source, points_source)
        positions.append(problem.camera.project(points_target).mT)
        valid.append(points_target[:, 2] >= MIN_DEPTH_RATIO * points_source[:, 2])
    return torch.stack(positions), torch.stack(valid)


def moved(problem: BundleProblem, state: BundleState, step: Tensor) -> BundleState:
    """Return the state after a step (6 P + D,): exp(xi) T for poses, d + step for disparities."""
    pose_unknowns = 6 * int(problem.free_poses.sum())
    xi = step.new_zeros(len(problem.free_poses), 6)
    xi = xi.index_put((problem.free_poses,), step[:pose_unknowns].reshape(-1, 6))
    added = torch.zeros_like(state.disparities)
    free = problem.free_disparities
    added = added.index_put((free,), step[pose_unknowns:].reshape(-1, added.shape[1]))
    return BundleState(se3_exp(xi) @ state.T_camera_world, state.disparities + added)


def dense_normal_equations(problem: BundleProblem, state: BundleState) -> DenseNormalEquations:
    """Return the equations of all unknowns (bundle_adjustment.py has its fast twin). Eq. (5)."""
    extensions = problem.free_focal, problem.shift_columns, problem.disparity_damping
    assert extensions == (False, None, None), "the twin has no such terms"
    poses = int(problem.free_poses.sum())
    frames = int(problem.free_disparities.sum())
    no_step = problem.rays.new_zeros(6 * poses + frames * len(problem.rays), dtype=torch.float64)

    def predicted(step: Tensor) -> Tensor:
        """Return what the flow and the prior measure: rows of one least-squares problem."""
        after = moved(problem, state, step)
        positions, _ = predicted_positions(problem, after)
        return torch.cat([positions.reshape(-1), after.disparities.reshape(-1)])

    positions, valid = predicted_positions(problem, state)
    residual = problem.targets - positions
    weight = problem.weights * valid[:, None]
    if problem.robust is not None:
        weight = weight * problem.robust.weight(residual.square().sum(1, keepdim=True))
    J = torch.func.jacrev(predicted)(no_step)
    prior_residual = problem.prior_disparities - state.disparities
    r = torch.cat([residual.reshape(-1), prior_residual.reshape(-1)])
    w = torch.cat([weight.reshape(-1), problem.prior_weights.reshape(-1)])
    return DenseNormalEquations(J.mT @ (w[:, None] * J), J.mT @ (w * r), 6 * poses)


def dense_step(
    problem: BundleProblem,
    state: BundleState,
    damping: float,  # relative, on disparities and on the marginalised poses
    absolute_damping: float,  # on the poses
) -> BundleState:
    """Return the state after one step of all unknowns; fast twin: `bundle_adjust`. Eq. (5)."""
    equations = dense_normal_equations(problem, state)
    split, matrix = equations.pose_unknowns, equations.matrix.clone()
    diagonal = matrix.diagonal()  # a view: what is written to it is written to the matrix

    observed = diagonal[split:] > 0
    mean = diagonal[split:].sum() / observed.sum().clamp_min(1)
    diagonal[split:] += damping * diagonal[split:] + DISPARITY_DAMPING * mean

    # The pose damping is relative to the Schur complement, in which disparities are marginalised.
    H, E, C = matrix[:split, :split], matrix[:split, split:], matrix[split:, split:]
    schur = H - E @ torch.linalg.solve(C, E.mT)
    diagonal[:split] += damping * schur.diagonal() + absolute_damping

    after = moved(problem, state, torch.linalg.solve(matrix, equations.vector))
    clamped = after.disparities.clamp_min(MIN_DISPARITY)
    kept = torch.where(problem.free_disparities[:, None], clamped, state.disparities)
    return BundleState(after.T_camera_world, kept)
