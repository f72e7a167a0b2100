"""The back-end on exact flow: what enters a bundle problem, what moves, and what is refused."""

import torch

from minislam.geometry import se3_exp, se3_inverse, se3_log
from minislam.tracking.backend import BackEnd
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from tests.tracking.scene import CAMERA
from tests.tracking.wall import GRID, TrueFlow, back_end, disparities_at, true_poses

XI = torch.tensor([0.03, -0.02, 0.02, 0.01, -0.01, 0.015], dtype=torch.float64)


def matched(count: int = 4, **settings: float) -> BackEnd:
    """Return a back-end at the truth whose neighbours are linked."""
    backend = back_end(list(range(count)), TrackingConfig(**settings))
    backend.match(neighbourhood_edges(0, count, 2))
    return backend


def pose_error(backend: BackEnd, keyframe: int) -> float:
    estimate = backend.keyframes.T_camera_world[keyframe]
    return float(se3_log(estimate @ se3_inverse(true_poses()[keyframe])).norm())


def move(backend: BackEnd, keyframe: int) -> None:
    poses = backend.keyframes.T_camera_world
    poses[keyframe] = se3_exp(XI) @ poses[keyframe]


# What enters a problem


def test_at_the_truth_all_residuals_are_zero():
    backend = matched()
    problem = backend.problem(range(len(backend.graph)), first_free=0)
    residual, valid = residuals(problem, backend.state)
    assert bool(valid.any()) and float((residual * problem.weights).abs().max()) < 1e-4


def test_weights_are_confidence_times_the_trust_in_both_ends():
    backend = matched(2)
    backend.keyframes.static_weights[0] = 0.5
    backend.keyframes.static_weights[1] = 0.25
    problem = backend.problem([0, 1], first_free=0)
    confidences = torch.stack(backend.graph.confidences)
    torch.testing.assert_close(problem.weights, 0.125 * confidences)


def test_the_first_pose_never_moves_and_older_keyframes_stay():
    problem = matched().problem(range(4), first_free=0)
    assert problem.free_poses.tolist() == [False, True, True, True]
    assert problem.free_disparities.tolist() == [True] * 4
    problem = matched().problem(range(4), first_free=2)
    assert problem.free_poses.tolist() == [False, False, True, True]
    assert problem.free_disparities.tolist() == [False, False, True, True]


def test_the_prior_weighs_where_it_is_known_and_grows_with_the_focal_length():
    backend = matched(lambda_disparity_prior=0.01)
    backend.keyframes.prior_disparities[1, 3] = 0.2
    weights = backend.problem(range(4), first_free=0).prior_weights
    assert float(weights[1, 3]) == torch.tensor(0.01 * CAMERA.fx**2)
    assert int((weights > 0).sum()) == 1
    assert float(backend.problem(range(4), 0, lambda_prior=0.0).prior_weights.sum()) == 0


# What moves


def test_a_displaced_keyframe_finds_its_place():
    # The two keyframes before it are held: they fix the unit of length.
    backend = matched(rounds=1)
    move(backend, 3)
    assert pose_error(backend, 3) > 0.03
    backend.adjust(first_free=3, iterations=8)
    assert pose_error(backend, 3) < 1e-3
    assert max(pose_error(backend, keyframe) for keyframe in range(3)) < 1e-12
    assert backend.reports[-1].cost_after < backend.reports[-1].cost_before


def test_a_new_keyframe_is_linked_and_adjusted_without_knowing_where_it_is():
    backend = matched()
    everything = backend.graph.edges()
    fresh = back_end(list(range(4)))
    fresh.match([edge for edge in everything if 3 not in edge])
    move(fresh, 3)
    steps = [fresh.flow.match([k], [k + 1], GRID.pixels.T[None]) for k in range(3)]
    fresh.adjust_newest(steps)
    assert {(0, 3), (1, 3), (2, 3), (3, 2)} <= set(fresh.graph.edges())
    first, last = fresh.keyframes.T_camera_world[0], fresh.keyframes.T_camera_world[3]
    assert torch.equal(first, true_poses()[0])
    # The unit of length may drift: it is the direction of the path that flow fixes.
    found, truth = (T[:3, 3] / T[:3, 3].norm() for T in (last, true_poses()[3]))
    assert float((found - truth).norm()) < 1e-2
    assert float((last[:3, :3] - true_poses()[3][:3, :3]).norm()) < 1e-3


def test_the_last_adjustment_keeps_the_truth():
    backend, calls = matched(), []
    backend.adjust_all(lambda done, of_all: calls.append((done, of_all)))
    rounds = backend.config.final_rounds
    assert calls == [(done, rounds) for done in range(1, rounds + 1)]
    assert max(pose_error(backend, keyframe) for keyframe in range(4)) < 1e-3


def test_the_unit_of_length_is_chosen_without_changing_any_image():
    backend = matched()
    problem = backend.problem(range(len(backend.graph)), first_free=0)
    before, _ = residuals(problem, backend.state)
    backend.normalise_scale()
    assert float(backend.keyframes.disparities.median()) == 1.0
    after, _ = residuals(problem, backend.state)
    torch.testing.assert_close(after, before, atol=1e-4, rtol=0)


def test_the_state_is_that_of_the_keyframes():
    backend = matched()
    state = backend.state
    backend.state = type(state)(state.T_camera_world.clone(), 2 * state.disparities)
    torch.testing.assert_close(
        backend.keyframes.disparities[2], 2 * disparities_at(true_poses()[2], GRID.rays).float()
    )


# What is refused


def test_a_new_link_needs_both_directions():
    flow = TrueFlow(ratios={(0, 3): 0.9, (3, 0): 0.05, (1, 3): 0.5, (3, 1): 0.4})
    backend = back_end([0, 1, 2, 3], TrackingConfig(min_link_ratio=0.1), flow)
    asked = [(0, 3), (3, 0), (1, 3), (3, 1)]
    assert backend.confirmed(asked) == [(1, 3), (3, 1)]
    assert backend.confirmed([]) == [] and len(backend.graph) == 0
