"""A pose from flow and a depth prior that has errors: depth and pose are adjusted together.

With depth held, an error of 10 % turns 10 px of parallax into 1 px of residual. In a smooth pattern
over the image that looks like a rotation, and the motion memory takes what then does not fit for
dynamic objects. So before anything is remembered, the depth of the source may give way, as far as
Eq. (5) lets it: by lambda_4 (d - 1 / D~)^2.
"""

from dataclasses import replace

import torch
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import BundleState, bundle_adjust
from minislam.tracking.grid import Grid
from minislam.tracking.pose_from_flow import motion_only_problem
from minislam.tracking.safeguards.robust import RobustKernel

WIDENING = (4.0, 1.0)  # times the final width of the robust weight [-]
ITERATIONS = 6  # Gauss-Newton steps per width


def pose_with_depth(
    grid: Grid,
    matches: FlowMatches,  # E = 1, source to target
    state: BundleState,  # of source and target: poses (2, 4, 4), disparities (2, N)
    prior_disparities: Tensor,  # (N,) of the source, 0 where unknown
    prior_strength: float,  # lambda_4 fx^2
    cell_weights: Tensor,  # (N,) in [0, 1] of the source
    robust: RobustKernel | None,
) -> Tensor:  # (4, 4)
    """Return T_target_world, adjusted together with the disparities of the source."""
    numbers = torch.arange(2, device=cell_weights.device)
    measured = matches.targets, matches.confidences * cell_weights
    problem = motion_only_problem(grid, numbers[:1], numbers[1:], *measured, numbers == 1, robust)
    prior = torch.stack([prior_disparities, torch.zeros_like(prior_disparities)])
    problem = replace(
        problem,
        free_disparities=numbers == 0,
        prior_disparities=prior,
        prior_weights=prior_strength * (prior > 0),
    )
    for widening in WIDENING if robust else (1.0,):
        problem = replace(problem, robust=robust and robust.widened(widening))
        state, _ = bundle_adjust(problem, state, ITERATIONS)
    return state.T_camera_world[1]
