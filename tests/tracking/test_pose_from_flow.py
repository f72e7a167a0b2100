"""Pose and disparities of a new view, on matches of a known room."""

import pytest
import torch

from minislam.geometry import se3_exp, se3_inverse
from minislam.tracking.pose_from_flow import (
    compose_matches,
    inverted_targets,
    start_pose,
    warp_disparities,
)
from minislam.tracking.safeguards.robust import RobustKernel
from tests.tracking.matches import CELLS, GRID, matches_to, room_disparities, seen_matches, sideways
from tests.tracking.scene import CAMERA, normal
from tests.tracking.wall import disparities_at, true_poses

# Composed matches and poses


def test_composed_matches_by_hand():
    # First by (8, 0), exactly one cell; then by a flow that grows by 0.1 px per px to the right.
    first = matches_to(GRID.pixels + torch.tensor([8.0, 0.0]))
    flow = torch.stack([0.1 * GRID.pixels[:, 0], torch.full((CELLS,), -2.0)], 1)
    confidence = GRID.pixels[:, 0] / 72
    composed = compose_matches(first, matches_to(GRID.pixels + flow, confidence), GRID)
    u, v = GRID.pixels.T
    inside = u + 8 <= 72
    expected = torch.stack([u + 8 + 0.1 * (u + 8), v - 2], 1)
    targets = composed.targets[0].T
    torch.testing.assert_close(targets[inside], expected[inside], rtol=1e-5, atol=1e-4)
    confidences = composed.confidences[0].T[inside, 0]
    torch.testing.assert_close(confidences, ((u + 8) / 72)[inside], rtol=1e-5, atol=1e-5)
    assert float(composed.matched_ratios) == pytest.approx(0.64)


def test_composed_matches_are_the_matches_of_the_composed_motion():
    # On a plane parallel to the image everything is affine, so that sampling is exact.
    disparities = torch.full((CELLS,), 0.5)
    a, b = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    a[:3, 3], b[:3, 3] = torch.tensor([-0.1, 0.1, 0.0]), torch.tensor([-0.05, 0.1, 0.2])
    composed = (
        compose_matches(seen_matches(a, disparities), seen_matches(b, disparities), GRID)
        .targets[0]
        .T
    )
    expected = seen_matches(b @ a, disparities).targets[0].T
    middle = seen_matches(a, disparities).targets[0].T
    inside = ((middle >= 0) & (middle <= torch.tensor([72.0, 48.0]))).all(1)
    assert inside.sum() > 40
    torch.testing.assert_close(composed[inside], expected[inside], rtol=0, atol=1e-3)


@pytest.mark.parametrize("robust", [None, RobustKernel(2.0)])
def test_a_pose_is_found_from_matches_and_disparities(robust: RobustKernel | None):
    truth, disparities = sideways(), room_disparities()
    before = se3_exp(0.3 * normal(8, 6))
    matches = seen_matches(truth, disparities)
    trust = torch.ones(CELLS)
    pose = start_pose(GRID, matches, disparities, trust, before, [before], robust)
    torch.testing.assert_close(pose, truth @ before, rtol=0, atol=1e-5)


def test_a_pose_ignores_cells_of_no_weight():
    truth, disparities, identity = sideways(), room_disparities(), torch.eye(4).double()
    targets = seen_matches(truth, disparities).targets[0].T.clone()
    targets[:30] += torch.tensor([9.0, 5.0])  # a mover that fills 3 of 7 rows
    trust = (torch.arange(CELLS) >= 30).float()
    found = start_pose(GRID, matches_to(targets), disparities, trust, identity, [identity], None)
    torch.testing.assert_close(found, truth, rtol=0, atol=1e-5)
    misled = start_pose(
        GRID, matches_to(targets), disparities, torch.ones(CELLS), identity, [identity], None
    )
    assert (misled - truth).abs().max() > 0.02


def test_the_cheapest_of_several_starts_is_kept():
    truth, disparities, identity = sideways(), room_disparities(), torch.eye(4).double()
    matches, trust = seen_matches(truth, disparities), torch.ones(CELLS)
    behind = se3_exp(torch.tensor([0.0, 0, -40.0, 0, 0, 0], dtype=torch.float64))
    for starts in ([behind, identity], [identity, behind]):
        pose = start_pose(GRID, matches, disparities, trust, identity, starts, RobustKernel(2.0))
        torch.testing.assert_close(pose, truth, rtol=0, atol=1e-5)


@pytest.mark.parametrize("mover_disparity", [1.0, 1.5])
def test_a_near_mover_does_not_take_the_pose_along(mover_disparity: float):
    # A robust weight that is only narrowed from wide ends in the mover, 0.26 to 0.35 away.
    is_mover = GRID.pixels[:, 0] < 0.3 * CAMERA.width
    disparities = torch.where(is_mover, mover_disparity, room_disparities())
    truth = se3_exp(torch.tensor([0.15, 0.02, 0.05, 0.01, -0.03, 0.0], dtype=torch.float64))
    seen, seen_of_mover = (
        seen_matches(motion, disparities).targets[0].T for motion in (truth, sideways(0.3))
    )
    targets = torch.where(is_mover[:, None], seen_of_mover, seen)
    known = disparities * (1 + 0.03 * normal(0, CELLS).float())
    pose = start_pose(
        GRID,
        matches_to(targets),
        known,
        torch.ones(CELLS),
        torch.eye(4).double(),
        [torch.eye(4).double()],
        RobustKernel(1.0),
    )
    assert (pose - truth)[:3, 3].norm() < 0.05


# Warped disparities


def test_warped_disparities_fill_holes_from_the_nearest_cell():
    disparities = torch.full((CELLS,), 0.4)
    disparities[GRID.pixels[:, 1] == 16] = 0.41
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -16 / (60 * 0.4)  # two cells to the left: two columns become holes
    warped = warp_disparities(GRID, transform, disparities).reshape(GRID.shape)
    expected = torch.full(GRID.shape, 0.4)
    expected[2] = 0.41
    torch.testing.assert_close(warped, expected)


def test_when_nothing_arrives_the_median_stands_in():
    disparities = room_disparities()
    turned = torch.eye(4, dtype=torch.float64)
    turned[0, 0] = turned[2, 2] = -1.0  # about face
    warped = warp_disparities(GRID, turned, disparities)
    assert (warped == disparities.median()).all()


def test_a_cell_of_disparity_zero_is_not_warped():
    disparities = torch.full((CELLS,), 0.4)
    disparities[::5] = 0.0
    assert (warp_disparities(GRID, torch.eye(4).double(), disparities) == 0.4).all()


# Inverted flow


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
