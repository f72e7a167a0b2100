"""The first geometry, on matches of a known scene: exact at first, then spoilt."""

import math
from dataclasses import replace

import pytest
import torch

from minislam.geometry import se3_exp, se3_inverse
from minislam.priors.flow import ClassicalFlow
from minislam.tracking import initialisation
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleReport,
    BundleState,
    bundle_adjust,
)
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.initialisation import (
    chain_state,
    first_disparity_hypotheses,
    first_geometry,
    minima,
)
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards.focal_length import FocalLengthFit
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.workers import Workers
from tests.tracking import oracle
from tests.tracking.matches import (
    CELLS,
    GRID,
    room_disparities,
    seen_matches,
    sideways,
)
from tests.tracking.scene import CAMERA, known_problem, normal, perturbed
from tests.tracking.wall import true_graph, true_poses

UNKNOWN = torch.zeros(3, CELLS)  # of three keyframes


# Known answers


def test_a_chain_with_known_disparities_finds_every_pose():
    truth = [torch.eye(4, dtype=torch.float64)]
    for seed in range(3):
        truth.append(se3_exp(0.02 * normal(seed, 6)) @ sideways(0.2) @ truth[-1])
    known = torch.stack([room_disparities(seed) for seed in range(4)])
    chain = [seen_matches(truth[k + 1] @ se3_inverse(truth[k]), known[k]) for k in range(3)]
    state = chain_state(GRID, chain, known[0], known, RobustKernel(2.0))
    torch.testing.assert_close(state.T_camera_world, torch.stack(truth), rtol=0, atol=1e-4)
    assert torch.equal(state.disparities, known)


def test_a_chain_carries_disparities_where_none_are_known():
    first, unknown = torch.full((CELLS,), 0.5), torch.zeros(2, CELLS)
    forward = torch.eye(4, dtype=torch.float64)
    forward[2, 3] = -0.4  # depth 2 becomes 1.6
    state = chain_state(GRID, [seen_matches(forward, first)], first, unknown, None)
    torch.testing.assert_close(state.T_camera_world[1], forward, rtol=0, atol=1e-5)
    expected = torch.full((CELLS,), 1 / 1.6)
    torch.testing.assert_close(state.disparities[1], expected, rtol=1e-4, atol=0)


# Hypotheses


def test_without_a_prior_the_hypotheses_are_walls_and_a_ground():
    (wall, knows), *slanted = first_disparity_hypotheses(GRID, UNKNOWN)
    assert torch.equal(wall, torch.ones(CELLS)) and not knows.any()
    x, y = GRID.pixels[:, 0] / CAMERA.width, GRID.pixels[:, 1] / CAMERA.height
    for (found, _), along in zip(slanted, (y, 1 - x, x), strict=True):
        torch.testing.assert_close(found, math.sqrt(1 / 3) * 3**along)  # from edge to edge x 3


def test_a_prior_is_the_first_hypothesis_and_not_the_only_one():
    prior = UNKNOWN.clone()
    prior[0, 5:] = torch.linspace(0.2, 0.4, CELLS - 5)
    (guess, knows), *others = first_disparity_hypotheses(GRID, prior)
    assert torch.equal(guess[5:], prior[0, 5:]) and (guess[:5] == prior[0, 5:].median()).all()
    assert knows is prior
    for expected, hypothesis in zip(first_disparity_hypotheses(GRID, UNKNOWN), others, strict=True):
        assert torch.equal(expected[0], hypothesis[0]) and not hypothesis[1].any()


def test_results_of_one_cost_are_one_minimum():
    costs = (100, 100.05, 200, 99.95, 300)

    class Told(Workers):
        def map(self, function, calls):
            return [(None, BundleReport(True, c, c, 1, 0.0, "")) for c in costs]

    results = minima(known_problem().problem, [], Told())
    assert [report.cost_after for _, report in results] == [100, 200, 300]


@pytest.mark.slow
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
        (best, _), *_ = sorted(minima(problem, states), key=lambda result: result[1].cost_after)
        torch.testing.assert_close(best.T_camera_world, poses, rtol=0, atol=1e-3)
    with Workers(2) as workers:  # the last order again, side by side
        shared = minima(problem, states, workers)
    for (state, _), (alone, _) in zip(shared, minima(problem, states), strict=True):
        assert torch.equal(state.T_camera_world, alone.T_camera_world)


@pytest.mark.slow
def test_a_wrong_prior_starts_the_search_and_does_not_bend_its_result():
    graph = true_graph(list(range(4)))
    keyframes, truth = graph.keyframes, true_poses()[:4]
    wrong = torch.tensor([[1.3], [0.8], [1.2], [0.7]])
    keyframes.prior_disparities = keyframes.disparities * wrong
    keyframes.set_geometry(torch.eye(4, dtype=torch.float64).repeat(4, 1, 1), keyframes.disparities)
    first_geometry(graph)
    found = [poses[:, :3, 3] for poses in (keyframes.T_camera_world, truth)]
    found = [centres / centres[-1].norm() for centres in found]
    assert float((found[0] - found[1]).abs().max()) < 1e-4  # with it: 6e-4
    rotations = [poses[:, :3, :3] for poses in (keyframes.T_camera_world, truth)]
    assert float((rotations[0] - rotations[1]).abs().max()) < 1e-4


def graph_with_focal(factor: float) -> KeyframeGraph:
    """Return the links of a walk along a wall under a focal length that is this much too long."""
    graph = true_graph([0, 2, 4, 6, 8, 10])
    graph.match(neighbourhood_edges(0, 6, 5))
    graph.grid.zoom(math.log(factor))
    graph.seeks_focal = True
    return graph


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.3, 0.4, 2.5])
def test_an_unknown_focal_length_is_found_from_a_guess_that_is_far_off(factor: float):
    graph = graph_with_focal(factor)
    first_geometry(graph)
    assert graph.focal_is_free
    assert graph.grid.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("worth_saving", "is_free"), [(0.05, True), (1.0, False)])
def test_a_focal_length_that_the_motion_does_not_tell_must_save_much(
    worth_saving: float, is_free: bool, monkeypatch: pytest.MonkeyPatch
):
    untold = (FocalLengthFit(1.0, None, 0.0), None)
    monkeypatch.setattr(initialisation, "fit_focal_length", lambda *_: untold)
    monkeypatch.setattr(initialisation, "FOCAL_WORTH_SAVING", worth_saving)
    graph = graph_with_focal(1.1)
    first_geometry(graph)
    assert graph.focal_is_free == is_free
    expected = CAMERA.fx if is_free else 1.1 * CAMERA.fx
    assert graph.grid.camera.fx == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_a_dynamic_object_that_outvotes_the_room_at_first_does_not_bend_the_start():
    # A man carries stones past the camera, and a table is pushed; all keyframes are of the start.
    clip = oracle.rendered_clip("stones", 61, 100, (160, 120))
    tracker = oracle.new_tracker(clip, ClassicalFlow(), TrackingConfig(), with_depth=False)
    oracle.follow(tracker, clip, range(100))
    tracker.initialise()
    assert oracle.keyframe_error(clip, tracker) < 2  # measured: 1.1 cm; from the widest alone 20.8


@pytest.mark.parametrize("seed", [50, 60, 70])
def test_guesses_that_are_far_off_still_find_the_truth(seed: int):
    known = known_problem()
    problem = replace(known.problem, robust=RobustKernel(0.3))
    guess = perturbed(known, 0.2, seed)
    # A weight that is narrow from the start stays in the basin of the guess.
    assert bundle_adjust(problem, guess, 36)[1].cost_after > 1
    ends = [bundle_adjust(problem, state, 0) for state, _ in minima(problem, [guess, guess])]
    assert min(report.cost_after for _, report in ends) < 1e-6
