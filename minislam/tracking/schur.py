"""The normal equations of the bundle adjustment: assembly, and the Schur complement.

Each disparity appears in one source frame only, so its block C is diagonal and cheap to invert:

    [ H   E ] [ xi ]   [ g ]        (H - E C^-1 E^T) xi = g - E C^-1 s
    [ E^T C ] [ dd ] = [ s ]   =>   dd = C^-1 (s - E^T xi)
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.tracking.bundle_problem import BundleProblem
from minislam.tracking.safeguards.parts import SourceBlocks


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations of Eq. (5): pose blocks by edge, disparity blocks, their coupling."""

    cost: float  # px^2, Eq. (5)
    edge_blocks: Tensor  # J^T W J (E, 6 + G, 6 + G) float64
    edge_gradients: Tensor  # J^T W r (E, 6 + G) float64
    adjoints: Tensor  # Ad(T_target_source) (E, 6, 6) float64
    disparity_diagonal: Tensor  # C (K, N)
    disparity_gradient: Tensor  # s (K, N)
    source_blocks: SourceBlocks  # per source k: k, rows (R,), E_k (R, N)


def marginalised(
    problem: BundleProblem,
    equations: NormalEquations,
    inverse_C: Tensor,  # (K, N)
) -> tuple[Tensor, Tensor]:  # (U, U), (U,) float64
    """Return H - E C^-1 E^T and g - E C^-1 s: the equations with the disparities marginalised.

    The unknowns U are 6 per free pose, then those of the camera. The inverse of this Schur
    complement, times the variance of a residual, is the covariance of the poses.
    """
    of_edges = equations.edge_blocks, equations.edge_gradients, equations.adjoints
    S, b = assemble_poses(problem, *of_edges)
    for source, rows, E in equations.source_blocks:
        scaled = E * inverse_C[source]
        S.index_put_((rows[:, None], rows[None, :]), -(scaled @ E.mT).double(), accumulate=True)
        b.index_add_(0, rows, -(scaled @ equations.disparity_gradient[source]).double())
    return S, b


def _pose_slots(problem: BundleProblem) -> Tensor:
    """Return the position of every keyframe among the free poses, -1 for a fixed one."""
    return torch.where(problem.free_poses, torch.cumsum(problem.free_poses.long(), 0) - 1, -1)


def assemble_poses(
    problem: BundleProblem, A: Tensor, b: Tensor, adjoint: Tensor
) -> tuple[Tensor, Tensor]:
    """Sum J^T W J = A and J^T W r = b of all edges over the free poses, targets and sources.

    With J_source = -J_target Ad: H_st = -Ad^T A, H_ss = Ad^T A Ad, g_s = -Ad^T b. The columns
    after the poses belong to the G camera parameters, common to all edges: these are just summed.
    """
    width = int(problem.free_poses.sum()) + 1  # the first slot is that of all fixed poses
    slots = _pose_slots(problem) + 1
    source, target = slots[problem.edges_source], slots[problem.edges_target]
    common, border, A = A[:, 6:, 6:].sum(0), A[:, :6, 6:], A[:, :6, :6]
    A_source = -adjoint.mT @ A  # rows of the source, columns of the target
    poses = 6 * width
    H = A.new_zeros(poses + len(common), poses + len(common))
    blocks = H[:poses, :poses].unflatten(1, (-1, 6)).unflatten(0, (-1, 6)).transpose(1, 2)
    blocks.index_put_((target, target), A, accumulate=True)
    blocks.index_put_((source, target), A_source, accumulate=True)
    blocks.index_put_((target, source), A_source.mT, accumulate=True)
    blocks.index_put_((source, source), -A_source @ adjoint, accumulate=True)
    right = torch.cat([border, b[:, :6, None]], 2)  # the border and g are summed alike
    B = right.new_zeros(width, 6, right.shape[2])
    B.index_add_(0, target, right)
    B.index_add_(0, source, -adjoint.mT @ right)
    border, g = B.flatten(0, 1).tensor_split([-1], 1)
    H[:poses, poses:], H[poses:, :poses], H[poses:, poses:] = border, border.T, common
    return H[6:, 6:], torch.cat([g[6:, 0], b[:, 6:].sum(0)])  # without the first slot


def source_blocks(
    problem: BundleProblem, E_target: Tensor, E_source: Tensor
) -> list[tuple[int, Tensor, Tensor]]:
    """Collect for each source frame the coupling of its disparities with the free poses.

    The rows of E_k belong to frame k itself (summed over its edges), to its targets and to the
    common columns, so the Schur complement is one small matrix product per source frame.
    """
    slots, targets = _pose_slots(problem).tolist(), problem.edges_target.tolist()
    common = [6 * (max(slots) + 1) + column for column in range(E_target.shape[1] - 6)]
    blocks, sources = [], problem.edges_source
    for source in sources[problem.free_disparities[sources]].unique().tolist():
        edges = (sources == source).nonzero()[:, 0].tolist()
        free = [edge for edge in edges if slots[targets[edge]] >= 0]
        own = [E_source[edges].sum(0)] if slots[source] >= 0 else []
        ends = [slots[source]] * len(own) + [slots[targets[edge]] for edge in free]
        rows = [6 * end + row for end in ends for row in range(6)] + common
        E = torch.cat([*own, *(E_target[edge, :6] for edge in free), E_target[edges, 6:].sum(0)])
        blocks.append((source, torch.tensor(rows, dtype=torch.long, device=E.device), E))
    return blocks
