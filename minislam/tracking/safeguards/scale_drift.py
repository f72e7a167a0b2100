"""Undo a drift of the scale that a depth prior reveals.

Flow ties the scale of a keyframe to that of its neighbours. Where the camera turns fast, few
keyframes see the same, and the scales of distant ones are hardly tied at all: to change them
together with the steps between them costs next to nothing in Eq. (5). A depth prior errs from
keyframe to keyframe, but not more and more. So the length of each step on the depth of the prior
alone, over its length as estimated, is averaged over many steps, each by how well its flow tells
it. That is the drift. It is undone after the last adjustment of all keyframes, because an
adjustment would bring a part of the drift back.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.tracking.bundle_adjustment import bundle_adjust, normal_equations
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.pose_from_flow import POSE_ITERATIONS, motion_only_problem
from minislam.tracking.reprojection import relative_transforms

SMOOTHED = 8.0  # steps, standard deviation of the window
SLOW_ERROR = 0.03  # standard deviation of a prior's error that many keyframes share [-]
WIDENING = 16.0  # of the robust weight: the errors of a prior are larger than those of flow [-]
FITTED = 16  # edges at once: their poses are the unknowns of one problem
SHORTEST = 1e-9  # world units: the length of a step that has none
UNKNOWN = 1e-6  # px^2 per squared unit step: information where flow tells no pose


def undo_scale_drift(graph: KeyframeGraph) -> None:
    """Rescale the steps of the camera and the disparities by the drift against the prior."""
    keyframes = graph.keyframes
    if not keyframes.has_prior or not (drift := told_drift(*step_ratios(graph))).any():
        return
    T_world_camera = se3_inverse(keyframes.T_camera_world)
    centres = T_world_camera[:, :3, 3]
    steps = centres.diff(dim=0) * ((drift[1:] + drift[:-1]) / 2).exp()[:, None]
    T_world_camera[1:, :3, 3] = centres[0] + steps.cumsum(0)
    disparities = keyframes.disparities * (-drift).exp().to(keyframes.disparities)[:, None]
    keyframes.set_geometry(se3_inverse(T_world_camera), disparities)


def step_ratios(graph: KeyframeGraph) -> tuple[Tensor, Tensor]:  # (K - 1,), (K - 1,) float64
    """Return ln(length by the prior / length as estimated) of each step, and its information.

    A step has an edge either way, each with the prior of its source; their mean counts.
    """
    ends, poses = graph.edges.ends, graph.keyframes.T_camera_world
    steps = [p for p, (i, j) in enumerate(ends) if abs(i - j) == 1]
    total, information = poses.new_zeros(2, len(poses) - 1)
    for part in (steps[first : first + FITTED] for first in range(0, len(steps), FITTED)):
        step = torch.tensor([min(ends[p]) for p in part], device=total.device)
        ratios, of_edges = _ratios_by_prior(graph, part)
        total.index_add_(0, step, of_edges * ratios)
        information.index_add_(0, step, of_edges)
    return torch.where(information > 0, total / information, 0), information


def _ratios_by_prior(graph: KeyframeGraph, positions: list[int]) -> tuple[Tensor, Tensor]:
    """Return the logarithm of the ratio, and its inverse variance at 1 px, of some edges (E,).

    A pose is fitted to the flow of each, on the prior's depth of the source alone. The inverse of
    the normal equations is its covariance C, so ln |t| has the variance t^T C t / |t|^4.
    """
    keyframes, edges, device = graph.keyframes, graph.edges, graph.grid.rays.device
    sources, targets = torch.tensor([edges.ends[p] for p in positions], device=device).mT
    disparities = keyframes.prior_disparities[sources]
    cells = keyframes.cell_weights[sources] * (disparities > 0)
    weights = torch.stack([edges.confidences[p] for p in positions]) * cells[:, None]
    count = len(positions)
    numbers = torch.arange(2 * count, device=device)  # the sources are held, at identity
    flow = torch.stack([edges.targets[p] for p in positions]), weights
    ends, robust = (numbers[:count], numbers[count:]), graph.robust
    robust = robust and robust.widened(WIDENING)
    problem = motion_only_problem(graph.grid, *ends, *flow, numbers >= count, robust)
    estimated = relative_transforms(keyframes.T_camera_world, sources, targets)
    held = torch.eye(4, device=device).to(estimated).expand_as(estimated)
    state = BundleState(torch.cat([held, estimated]), disparities.repeat(2, 1))
    state, _ = bundle_adjust(problem, state, POSE_ITERATIONS)
    blocks = normal_equations(problem, state).edge_blocks
    covariance = torch.linalg.inv(blocks + UNKNOWN * torch.eye(6, device=device))[:, :3, :3]
    t = state.T_camera_world[count:, :3, 3]
    variance = torch.einsum("ei,eij,ej->e", t, covariance, t)
    length, before = (v.norm(dim=1).clamp_min(SHORTEST) for v in (t, estimated[:, :3, 3]))
    information = length**4 / variance.clamp_min(SHORTEST**4)
    return (length / before).log(), information * (cells > 0).any(1)


def told_drift(ratios: Tensor, information: Tensor) -> Tensor:  # (K,) float64
    """Return ln(length by the prior / length as estimated) around each keyframe, 0 in the mean.

    The prior's own error is taken off the drift's variance: if it explains all, the drift is 0.
    """
    if not information.any():
        return information.new_zeros(len(information) + 1)
    position = torch.arange(len(ratios) + 1, device=ratios.device).to(ratios)
    middle = (position[1:] + position[:-1]) / 2
    window = -0.5 * ((position[:, None] - middle) / SMOOTHED) ** 2  # its logarithm
    weights = (window + information.log()).softmax(1)  # far from all priors: the nearest step's
    drift = weights @ ratios
    drift = drift - drift.mean()
    # What differs from the drift is noise, of which the window leaves little.
    rest = information * (ratios - (drift[1:] + drift[:-1]) / 2).square()
    noise = rest[information > 0].mean()
    spread = weights.square() / information.clamp_min(torch.finfo(information.dtype).tiny)
    error = SLOW_ERROR**2 + (noise * spread.sum(1)).mean()
    return drift * (1 - error / torch.maximum(drift.square().mean(), error))
