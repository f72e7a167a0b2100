"""How precisely the flow measures the scale along a trajectory, not in the paper.

A single camera knows lengths only as multiples of those before, by points that several keyframes
see from far enough apart. Where a fast turn, a plain wall or a dynamic object leaves few of them,
two parts of a trajectory can differ in scale although each fits its flow. Eq. (5) tells how far:
the inverse of its Schur complement, times the mean squared residual, is the poses' covariance.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.tracking.bundle_adjustment import normal_equations, residuals
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.safeguards.parts import in_parts
from minislam.tracking.schur import marginalised

REACH = 3  # keyframes: the usual distance over so many is the length that is compared
LEAST_C = 1e-6  # fraction of the mean C, added to all: more would act as a prior of the depth [-]
HOLD = 1e-8  # relative damping of the poses: fixes the scale of the whole, which is free [-]


def scale_deviations(problem: BundleProblem, state: BundleState) -> dict[int, float]:
    """Return the standard deviation of ln(length after / length before) of keyframes [-].

    The first pose must be fixed, all others and all disparities free, and the state adjusted.
    Keyframes that lack a length before or after are left out; of singular equations, all are.
    """
    gradients = dict(_log_ratio_gradients(state))
    if not gradients:
        return {}
    equations = normal_equations(problem, state)
    C = equations.disparity_diagonal
    S, _ = marginalised(problem, equations, (C + LEAST_C * C[C > 0].mean()).reciprocal())
    S.diagonal().mul_(1 + HOLD)
    factor, failure = torch.linalg.cholesky_ex(S)
    rows = torch.stack([gradient[1:].flatten() for gradient in gradients.values()])
    whitened = torch.linalg.solve_triangular(factor, rows.T, upper=False)
    deviations = (_variance(problem, state) * whitened.square().sum(0)).sqrt().tolist()
    return {} if failure else dict(zip(gradients, deviations, strict=True))


def _variance(problem: BundleProblem, state: BundleState) -> Tensor:  # px^2
    """Return the mean squared residual, by weight."""
    squares = weighed = state.T_camera_world.new_zeros(())
    for _, part in in_parts(problem):
        residual, weights = residuals(part, state)
        squares = squares + (weights * residual.square()).sum()
        weighed = weighed + weights.sum()
    return squares / weighed.clamp_min(1e-6)


def _log_ratio_gradients(state: BundleState) -> Iterator[tuple[int, Tensor]]:  # k, (K, 6)
    """Yield the derivative of ln(length after / length before) by the twists of all poses.

    The length after a keyframe is the distance to the first later one at least as far away as
    keyframes REACH apart usually are; the length before, to the last such earlier one.
    """
    poses = state.T_camera_world
    centres = se3_inverse(poses)[:, :3, 3]
    distances = torch.cdist(centres, centres)
    if len(poses) <= REACH:
        return
    usual = distances.diagonal(REACH).median()
    for keyframe, row in enumerate(distances):
        far = (row >= usual).nonzero()[:, 0]
        before, after = far[far < keyframe].tolist(), far[far > keyframe].tolist()
        if not (before and after and usual > 0):
            continue
        gradient = poses.new_zeros(len(poses), 6)
        for end, sign in ((after[0], 1), (before[-1], -1)):
            along = sign * (centres[end] - centres[keyframe]) / row[end].square()
            # The centre c = -R^T t moves by -R^T v, v being the translation of the twist.
            gradient[end, :3] -= poses[end, :3, :3] @ along
            gradient[keyframe, :3] += poses[keyframe, :3, :3] @ along
        yield keyframe, gradient
