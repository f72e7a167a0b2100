"""The focal length that the flow wants: found where the camera turns, untold where it does not."""

import math
from dataclasses import replace

import pytest
import torch

from minislam.geometry import se3_exp
from minislam.tracking.bundle_adjustment import BundleReport
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import warm_up_ba
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards import focal_length
from minislam.tracking.safeguards.focal_column import zoomed
from minislam.tracking.safeguards.focal_length import (
    FocalLengthFit,
    check_focal_length,
    fit_focal_length,
    seek_focal_length,
)
from minislam.workers import Workers
from tests.tracking.scene import CAMERA, RAYS, known_problem, noisy, normal, poses_on_an_arc
from tests.tracking.wall import disparities_at, true_graph

NOISE = 0.1  # px
FOUND = 0.005  # relative


def seen_through(problem: BundleProblem, factor: float) -> BundleProblem:
    """Return the problem of someone who believes in `factor` times the true focal length."""
    camera = problem.camera
    wrong = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    rays = problem.rays / problem.rays.new_tensor([factor, factor, 1.0])
    return replace(problem, camera=wrong, rays=rays)


def without_turning() -> tuple[BundleProblem, BundleState]:
    """Return a problem, with noise, of a camera that keeps its direction."""
    known = known_problem()
    poses = se3_exp(torch.zeros(4, 6, dtype=torch.float64))
    poses[:, :3, 3] = poses_on_an_arc(4, seed=0)[:, :3, 3]
    state = BundleState(poses, known.truth.disparities)
    ends = known.problem.edges_source, known.problem.edges_target
    transforms = relative_transforms(poses, *ends)
    targets, _ = reproject(transforms, state.disparities[ends[0]], RAYS, CAMERA)
    targets = targets + NOISE * normal(9, *targets.shape)
    return replace(known.problem, targets=targets), state


@pytest.mark.parametrize("factor", [0.75, 0.9, 1.0, 1.1, 1.3])
def test_the_true_focal_length_is_found(factor: float):
    known = known_problem(keyframes=8)
    fit, state = fit_focal_length(seen_through(noisy(known, NOISE), factor), known.truth)
    assert fit.present == pytest.approx(factor * CAMERA.fx)
    assert fit.factor * factor == pytest.approx(1, rel=FOUND)
    assert fit.factor == pytest.approx(math.exp(state.log_focal))
    assert fit.is_doubtful == (factor != 1)


def test_the_search_goes_on_from_its_start():
    asked = []

    class Recording(Workers):
        def map(self, function, calls):
            asked.append(calls)
            return super().map(function, calls)

    known, workers = known_problem(keyframes=8), Recording()
    problem, start = seen_through(noisy(known, NOISE), 1.3), replace(known.truth, log_focal=-0.2)
    fit, _ = fit_focal_length(problem, known.truth, workers, start)
    (held, state, *_), (free, begun, *_) = asked[0]
    assert state is known.truth and begun is start and free.free_focal and not held.free_focal
    assert fit.factor * 1.3 == pytest.approx(1, rel=FOUND)


@pytest.mark.slow
def test_two_processes_find_the_same():
    known = known_problem()
    problem = seen_through(noisy(known, NOISE), 1.1)
    with Workers(2) as workers:
        shared, there = fit_focal_length(problem, known.truth, workers)
    alone, here = fit_focal_length(problem, known.truth)
    assert shared == alone and torch.equal(there.disparities, here.disparities)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
def test_a_camera_that_does_not_turn_tells_nothing(factor: float):
    problem, state = without_turning()
    fit, end = fit_focal_length(seen_through(problem, factor), state)
    assert fit.factor is None and not fit.is_doubtful
    assert end is state


def test_residuals_below_what_any_flow_can_do_tell_nothing():
    # One keyframe twice: whatever the focal length, all residuals are zero up to rounding.
    graph = true_graph([0, 0])
    graph.match([(0, 1), (1, 0)])
    assert check_focal_length(graph).factor is None


def test_a_focal_length_out_of_reach_is_no_estimate():
    known = known_problem()
    fit, _ = fit_focal_length(seen_through(noisy(known, NOISE), 2.5), known.truth)
    assert fit.factor is None


@pytest.mark.parametrize(
    ("saved", "rise", "tells"),
    [(0.01, 0.013, True), (0.01, 0.011, False), (0.03, 0.004, True), (0.06, 0.0014, False)],
)
def test_in_a_flat_valley_a_focal_length_needs_to_save_much(saved: float, rise: float, tells: bool):
    known, lowest = known_problem(), 1e6  # px^2

    class Made(Workers):
        def map(self, function, calls):
            is_beside = calls[0][2] == [1.0]
            costs = [1 + rise, 1 + rise] if is_beside else [1 / (1 - saved), 1]
            reports = [BundleReport(True, 0.0, lowest * cost, 1, 1e-4) for cost in costs]
            states = known.truth, replace(known.truth, log_focal=-0.4)
            return list(zip(states, reports, strict=True))

    fit, _ = fit_focal_length(known.problem, known.truth, Made())
    assert fit.factor == (pytest.approx(math.exp(-0.4)) if tells else None)


def turned_graph(factor: float) -> KeyframeGraph:
    """Return a graph with true flow for which a wrong focal length is assumed."""
    graph = true_graph([0, 2, 4, 6, 8, 10])
    graph.match(neighbourhood_edges(0, 6, 5))
    graph.grid.zoom(math.log(factor))
    return graph


def test_an_unknown_focal_length_is_replaced_and_from_then_on_refined():
    graph = turned_graph(1.2)
    graph.seeks_focal = True
    seek_focal_length(graph)
    assert graph.focal_is_free
    assert graph.grid.camera.fx == pytest.approx(CAMERA.fx, rel=FOUND)
    graph.grid.zoom(math.log(1.02))
    warm_up_ba(graph, graph.edges.ends, 1)
    assert graph.grid.camera.fx == pytest.approx(CAMERA.fx, rel=FOUND)


def test_a_given_focal_length_stays():
    graph = turned_graph(1.2)
    seek_focal_length(graph)
    warm_up_ba(graph, graph.edges.ends, 1)
    assert not graph.focal_is_free
    assert graph.grid.camera.fx == pytest.approx(1.2 * CAMERA.fx)


def test_the_check_changes_nothing():
    graph = true_graph([0, 3, 6])
    graph.match([(0, 1), (1, 0), (1, 2), (2, 1)])
    poses, disparities = graph.state.T_camera_world.clone(), graph.state.disparities.clone()
    check_focal_length(graph)
    assert torch.equal(graph.state.T_camera_world, poses)
    assert torch.equal(graph.state.disparities, disparities)


def test_a_check_adjusts_the_first_keyframes_alone(monkeypatch: pytest.MonkeyPatch):
    # A pose far off, behind the limit, and its edges cannot disturb the check.
    expected = check_focal_length(turned_graph(1.2))
    graph = true_graph([0, 2, 4, 6, 8, 10, 11, 9])
    graph.match(neighbourhood_edges(0, 6, 5))
    graph.match(neighbourhood_edges(6, 8, 5))
    graph.grid.zoom(math.log(1.2))
    graph.keyframes.T_camera_world[6:, :3, 3] += 1.0
    monkeypatch.setattr(focal_length, "MOST_KEYFRAMES", 6)
    assert check_focal_length(graph) == expected
    assert expected.factor == pytest.approx(1 / 1.2, rel=FOUND)


@pytest.mark.parametrize(
    "parts", [(99, 49, 50), (100, 50, 50), (100, 50, 51), (100, 65, 65), (100, 100)]
)
def test_a_check_costs_no_more_above_a_hundred_keyframes(monkeypatch, parts: tuple[int, ...]):
    asked, fits = [], FocalLengthFit(272.0, 1.0, 0.0)
    monkeypatch.setattr(
        focal_length, "fit_focal_length", lambda *parts: asked.append(parts) or [fits]
    )
    keyframes = sum(parts[-2:])  # the halves; of 200 the first is the whole that was adjusted
    graph = true_graph([number % 12 for number in range(keyframes)])
    graph.match(neighbourhood_edges(1, keyframes, 1))
    check_focal_length(graph)
    for (problem, state, _), used in zip(asked, parts, strict=True):
        assert len(state.T_camera_world) == len(state.disparities) == used
        assert len(problem.edges_source) == len(problem.targets) == 2 * (used - 1)
        assert problem.free_poses.tolist() == [False] + [True] * (used - 1)


def zoomed_graph(zooms: list[float]) -> KeyframeGraph:
    """Return a graph of a lens whose focal length is another one in each part of the keyframes."""
    graph = true_graph([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
    size = len(graph.keyframes) // len(zooms)
    edges = neighbourhood_edges(0, len(graph.keyframes), 3)
    graph.match([(i, j) for i, j in edges if i // size == j // size])
    poses = graph.keyframes.T_camera_world
    for position, (source, target) in enumerate(graph.edges.ends):
        camera, rays = zoomed(CAMERA, RAYS, math.log(zooms[source // size]))
        disparities = disparities_at(poses[source], rays)[None]
        transforms = relative_transforms(poses, [source], [target])
        seen, _ = reproject(transforms, disparities, rays, camera)
        graph.edges.targets[position] = seen[0].float()
    return graph


def test_a_zoom_about_the_present_focal_length_is_seen_in_the_halves():
    found = check_focal_length(zoomed_graph([0.85, 1.18]))
    assert found.is_doubtful and found.half == (0, 5)
    assert found.factor == pytest.approx(0.85, rel=FOUND)


def test_a_found_focal_length_is_checked_in_the_halves_alone():
    graph = zoomed_graph([1.0, 1.3])
    graph.seeks_focal = True
    assert check_focal_length(graph).half == (6, 11)
    graph = true_graph([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
    graph.match(neighbourhood_edges(0, 12, 3))
    assert check_focal_length(graph).half is None
    graph.seeks_focal = True
    assert check_focal_length(graph) is None


def test_a_half_without_links_tells_nothing():
    graph = true_graph([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
    graph.match(neighbourhood_edges(0, 6, 3))
    assert check_focal_length(graph).half is None


@pytest.mark.parametrize(
    ("factor", "saved", "is_doubtful"),
    [(1.1, 0.3, True), (0.9, 0.3, True), (1.03, 0.3, False), (1.1, 0.01, False)],
)
def test_only_a_clear_difference_is_worth_saying(factor: float, saved: float, is_doubtful: bool):
    assert FocalLengthFit(272.0, factor, saved).is_doubtful == is_doubtful
    assert not FocalLengthFit(272.0, factor, min(saved, 0.09), half=(0, 9)).is_doubtful
