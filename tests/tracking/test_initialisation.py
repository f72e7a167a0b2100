"""The first geometry, on matches of a known scene: exact at first, then spoilt."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import BundleProblem, BundleState, bundle_adjust
from minislam.tracking.grid import Grid
from minislam.tracking.initialisation import (
    best_hypothesis,
    carry_disparities,
    chain_state,
    compose_matches,
    essential_disparities,
    first_disparity_hypotheses,
    start_pose,
    triangulate,
)
from minislam.tracking.reprojection import reproject
from minislam.tracking.robust import RobustKernel
from tests.tracking.scene import CAMERA, STRIDE, known_problem, normal, perturbed, uniform

GRID = Grid.of(CAMERA, STRIDE)
CELLS = len(GRID.rays)


def matches_to(targets: Tensor, confidence: Tensor | float = 1.0) -> FlowMatches:
    """Return the matches (E = 1) with these targets (N, 2)."""
    confidences = (torch.ones(CELLS) * confidence).expand(1, 2, CELLS)
    return FlowMatches(targets.float().T[None], confidences, torch.tensor([0.8]))


def seen_matches(T_target_source: Tensor, disparities: Tensor) -> FlowMatches:
    """Return the true matches of a source whose cells have these disparities (N,)."""
    transform = T_target_source.to(disparities.dtype)[None]
    positions, valid = reproject(transform, disparities[None], GRID.rays, CAMERA)
    assert valid.all()
    return matches_to(positions[0].T)


def flat(matches: FlowMatches) -> tuple[Tensor, Tensor]:
    """Return targets [px] and confidences, each (N, 2)."""
    return matches.targets[0].T, matches.confidences[0].T


def triangulated(T_target_source: Tensor, matches: FlowMatches) -> Tensor:
    targets, confidences = flat(matches)
    return triangulate(GRID, T_target_source, targets, confidences[:, 0] > 0.5)


def room_disparities(seed: int = 0) -> Tensor:
    """Return disparities (N,) float32 of a slanted wall with bumps, median about 0.5."""
    slant = 0.3 + 0.004 * GRID.pixels[:, 0] + 0.002 * GRID.pixels[:, 1]
    return slant + 0.08 * uniform(seed, CELLS).float()


def sideways(length: float = 0.25) -> Tensor:
    return se3_exp(torch.tensor([length, 0.04, 0.05, 0.02, -0.03, 0.04], dtype=torch.float64))


# Known answers


def test_triangulation_by_hand():
    # Sideways by 0.5 at fx = 60 px: a cell that moves 12 px has disparity 0.4, 24 px: 0.8.
    flow = torch.where(torch.arange(CELLS) % 3 == 0, 24.0, 12.0)
    targets = GRID.pixels - torch.stack([flow, torch.zeros(CELLS)], 1)
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -0.5
    disparities = triangulated(transform, matches_to(targets))
    expected = torch.where(flow == 24.0, 2.0, 1.0)  # in units of the median
    torch.testing.assert_close(disparities, expected, rtol=1e-5, atol=0)


def test_triangulation_recovers_a_room_up_to_scale():
    truth = room_disparities()
    for scale in (1.0, 7.0):
        transform = sideways()
        matches = seen_matches(transform, truth)
        transform[:3, 3] *= scale  # the length of the step cannot be seen, nor does it matter
        recovered = triangulated(transform, matches)
        torch.testing.assert_close(recovered, truth / truth.median(), rtol=2e-3, atol=0)


def test_triangulation_gives_doubtful_cells_the_median():
    truth, transform = room_disparities(), sideways()
    matches = seen_matches(transform, truth)
    targets, confidence = matches.targets[0].T.clone(), torch.ones(CELLS)
    confidence[3] = 0.2
    targets[5] = 2 * GRID.pixels[5] - targets[5]  # the wrong way: a point behind both cameras
    targets[7] += 40 * (targets[7] - GRID.pixels[7])  # forty times too near
    recovered = triangulated(transform, matches_to(targets, confidence))
    assert (recovered[[3, 5, 7]] == 1).all()
    others = torch.ones(CELLS, dtype=torch.bool)
    others[[3, 5, 7]] = False
    ratio = recovered[others] / truth[others]
    assert ratio.max() / ratio.min() < 1.01


def test_the_essential_matrix_gives_the_room_without_a_pose():
    truth = room_disparities()
    # RANSAC accepts 0.7 px: with little parallax a wrong matrix would explain the matches as well.
    disparities = essential_disparities(GRID, *flat(seen_matches(sideways(0.6), truth)))
    assert disparities is not None
    ratio = disparities / (truth / truth.median())
    assert ratio.median() == pytest.approx(1, abs=0.02)
    assert (ratio - 1).abs().median() < 0.02


def test_the_essential_matrix_survives_outliers_and_repeats_itself():
    truth = room_disparities()
    targets = seen_matches(sideways(0.5), truth).targets[0].T
    is_outlier = (uniform(3, CELLS, 1) < 0.2).expand(CELLS, 2)
    spoilt = torch.where(is_outlier, targets + 15 * normal(4, CELLS, 2).float(), targets)
    first = essential_disparities(GRID, *flat(matches_to(spoilt)))
    assert torch.equal(first, essential_disparities(GRID, *flat(matches_to(spoilt))))
    good = ~is_outlier[:, 0]
    ratio = first[good] / (truth / truth.median())[good]
    assert (ratio / ratio.median() - 1).abs().median() < 0.05


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


def test_a_pose_ignores_what_is_not_trusted():
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
        flat(seen_matches(motion, disparities))[0] for motion in (truth, sideways(0.3))
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


def test_a_chain_with_known_disparities_finds_every_pose():
    truth = [torch.eye(4, dtype=torch.float64)]
    for seed in range(3):
        truth.append(se3_exp(0.02 * normal(seed, 6)) @ sideways(0.2) @ truth[-1])
    known = torch.stack([room_disparities(seed) for seed in range(4)])
    chain = [seen_matches(truth[k + 1] @ se3_inverse(truth[k]), known[k]) for k in range(3)]
    state, _ = chain_state(GRID, chain, known[0], known, RobustKernel(2.0), None)
    torch.testing.assert_close(state.T_camera_world, torch.stack(truth), rtol=0, atol=1e-4)
    assert torch.equal(state.disparities, known)


def test_a_chain_carries_disparities_where_none_are_known():
    first, unknown = torch.full((CELLS,), 0.5), torch.zeros(2, CELLS)
    forward = torch.eye(4, dtype=torch.float64)
    forward[2, 3] = -0.4  # depth 2 becomes 1.6
    state, _ = chain_state(GRID, [seen_matches(forward, first)], first, unknown, None, None)
    torch.testing.assert_close(state.T_camera_world[1], forward, rtol=0, atol=1e-5)
    expected = torch.full((CELLS,), 1 / 1.6)
    torch.testing.assert_close(state.disparities[1], expected, rtol=1e-4, atol=0)


# Carried disparities


def test_carried_disparities_fill_holes_from_the_nearest_cell():
    disparities = torch.full((CELLS,), 0.4)
    disparities[GRID.pixels[:, 1] == 16] = 0.41
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -16 / (60 * 0.4)  # two cells to the left: two columns become holes
    carried = carry_disparities(GRID, transform, disparities).reshape(GRID.shape)
    expected = torch.full(GRID.shape, 0.4)
    expected[2] = 0.41
    torch.testing.assert_close(carried, expected)


def test_when_nothing_is_carried_the_median_stands_in():
    disparities = room_disparities()
    turned = torch.eye(4, dtype=torch.float64)
    turned[0, 0] = turned[2, 2] = -1.0  # about face
    carried = carry_disparities(GRID, turned, disparities)
    assert (carried == disparities.median()).all()


# Hypotheses


def test_the_first_hypothesis_is_a_wall():
    truth = room_disparities()
    hypotheses = list(first_disparity_hypotheses(GRID, [flat(seen_matches(sideways(), truth))]))
    assert len(hypotheses) == 2
    assert torch.equal(hypotheses[0], torch.ones(CELLS))
    assert hypotheses[1].median() == pytest.approx(1, abs=0.05)


def test_hypotheses_without_confident_matches_are_the_wall_alone():
    blind = matches_to(GRID.pixels, 0.1)
    assert essential_disparities(GRID, *flat(blind)) is None
    assert len(list(first_disparity_hypotheses(GRID, 2 * [flat(blind)]))) == 1
    assert torch.equal(triangulated(sideways(), blind), torch.ones(CELLS))


def test_matches_that_stand_still_give_finite_disparities():
    standing = matches_to(GRID.pixels)
    disparities = essential_disparities(GRID, *flat(standing))
    assert disparities is None or bool(torch.isfinite(disparities).all())
    assert torch.isfinite(triangulated(torch.eye(4), standing)).all()


def test_the_best_hypothesis_is_the_one_that_explains_the_matches():
    truth, disparities = sideways(), room_disparities()
    forward, backward = seen_matches(truth, disparities), room_disparities(5)
    returned = seen_matches(se3_inverse(truth), backward)
    targets = torch.cat([forward.targets, returned.targets])
    problem = BundleProblem(
        camera=CAMERA,
        rays=GRID.rays,
        edges_source=torch.tensor([0, 1]),
        edges_target=torch.tensor([1, 0]),
        targets=targets,
        weights=torch.ones_like(targets),
        prior_disparities=torch.zeros(2, CELLS),
        prior_weights=torch.zeros(2, CELLS),
        free_poses=torch.tensor([False, True]),
        free_disparities=torch.ones(2, dtype=torch.bool),
    )
    poses = torch.stack([torch.eye(4, dtype=torch.float64), truth])
    right = BundleState(poses, torch.stack([disparities, backward]))
    away = poses.clone()
    away[1] = se3_exp(torch.tensor([0.0, 0, 0, 0, 2.5, 0], dtype=torch.float64))
    wrong = BundleState(away, right.disparities)
    for states in ([wrong, right], [right, wrong]):
        best = best_hypothesis(problem, states)
        torch.testing.assert_close(best.T_camera_world, poses, rtol=0, atol=1e-3)


@pytest.mark.parametrize("seed", [50, 60, 70])
def test_guesses_that_are_far_off_still_find_the_truth(seed: int):
    known = known_problem()
    problem = replace(known.problem, robust=RobustKernel(0.3))
    guess = perturbed(known, 0.2, seed)
    # A weight that is narrow from the start stays in the basin of the guess.
    assert bundle_adjust(problem, guess, 36)[1].cost_after > 1
    best = best_hypothesis(problem, [guess, guess])
    assert bundle_adjust(problem, best, 0)[1].cost_after < 1e-6
