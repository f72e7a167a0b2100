"""The inverse of a flow: known answers, and there and back again."""

import torch

from minislam.geometry import se3_inverse
from minislam.tracking.safeguards.inverse_flow import inverted_targets
from tests.tracking.matches import CELLS, GRID, seen_matches
from tests.tracking.wall import disparities_at, true_poses


def test_a_shift_is_inverted_by_the_opposite_shift():
    shift = torch.tensor([5.0, -3.0])
    inverse = inverted_targets((GRID.pixels + shift).T[None], GRID)
    torch.testing.assert_close(inverse, (GRID.pixels - shift).T[None], rtol=0, atol=1e-4)


def test_the_inverse_leads_to_where_the_flow_back_leads():
    poses = true_poses()
    motion = poses[2] @ se3_inverse(poses[0])
    forward, back = (
        seen_matches(T, disparities_at(poses[k], GRID.rays).float()).targets
        for T, k in ((motion, 0), (se3_inverse(motion), 2))
    )
    assert (forward - GRID.pixels.T).abs().max() > 3
    found = inverted_targets(forward, GRID)
    inside = GRID.camera.contains(back[0].mT)
    assert int(inside.sum()) > CELLS // 2
    torch.testing.assert_close(found[0, :, inside], back[0, :, inside], rtol=0, atol=0.5)
