"""A pose from a depth prior with errors: exact where it is exact, better where it is not."""

import torch

from minislam.tracking.bundle_adjustment import BundleState
from minislam.tracking.pose_from_flow import start_pose
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.tracking.safeguards.two_views import pose_with_depth
from tests.tracking.matches import CELLS, GRID, room_disparities, seen_matches, sideways

HERE = torch.eye(4, dtype=torch.float64)
ONES = torch.ones(CELLS)
STRENGTH = 0.0005 * 60**2


def refined(prior: torch.Tensor, start: torch.Tensor, robust: RobustKernel | None) -> torch.Tensor:
    matches = seen_matches(sideways(), room_disparities())
    state = BundleState(torch.stack([HERE, start]), prior.expand(2, -1))
    return pose_with_depth(GRID, matches, state, prior, STRENGTH, ONES, robust)


def test_an_exact_prior_keeps_the_exact_pose():
    for robust in (None, RobustKernel(1.0)):
        found = refined(room_disparities(), sideways(), robust)
        torch.testing.assert_close(found, sideways(), rtol=0, atol=1e-5)


def test_a_wavy_error_of_the_prior_turns_the_camera_less():
    wave = torch.sin(GRID.pixels[:, 0] / 80 * 6.28) * torch.cos(GRID.pixels[:, 1] / 56 * 6.28)
    prior = room_disparities() * (1 + 0.15 * wave)
    matches = seen_matches(sideways(), room_disparities())
    held = start_pose(GRID, matches, prior, ONES, HERE, [HERE], RobustKernel(1.0))
    free = refined(prior, held, RobustKernel(1.0))
    assert (free - sideways()).norm() < 0.5 * (held - sideways()).norm()
