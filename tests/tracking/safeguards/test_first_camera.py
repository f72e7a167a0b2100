"""The start of an unknown camera: which minimum is taken, its focal length and its readout."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleReport,
    BundleState,
    bundle_adjust,
)
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.initialisation import first_geometry
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards import first_camera
from minislam.tracking.safeguards.first_camera import Found, minima, most_plausible
from minislam.tracking.safeguards.focal_length import FocalLengthFit, seek_readouts
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.tracking.safeguards.rolling_shutter import Readout, displacements
from minislam.workers import Workers
from tests.tracking.matches import CELLS, GRID, room_disparities, seen_matches, sideways
from tests.tracking.scene import CAMERA, known_problem, perturbed
from tests.tracking.wall import FRAMES, TrueFlow, true_graph, true_poses

UNKNOWN = torch.zeros(2, CELLS)  # of two keyframes


# Minima


def test_results_of_one_cost_are_one_minimum():
    costs = (100, 100.05, 200, 99.95, 300)

    class Told(Workers):
        def map(self, function, calls):
            return [(None, BundleReport(True, c, c, 1, 0.0)) for c in costs]

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


@pytest.mark.parametrize("seed", [50, 60, 70])
def test_guesses_that_are_far_off_still_find_the_truth(seed: int):
    known = known_problem()
    problem = replace(known.problem, robust=RobustKernel(0.3))
    guess = perturbed(known, 0.2, seed)
    # A weight that is narrow from the start stays in the basin of the guess.
    assert bundle_adjust(problem, guess, 36)[1].cost_after > 1
    ends = [bundle_adjust(problem, state, 0) for state, _ in minima(problem, [guess, guess])]
    assert min(report.cost_after for _, report in ends) < 1e-6


# A focal length that is not known


def graph_with_focal(factor: float) -> KeyframeGraph:
    """Return the edges of a walk along a wall under a focal length that is this much too long."""
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
    monkeypatch.setattr(first_camera, "fit_focal_length", lambda *_: untold)
    monkeypatch.setattr(first_camera, "FOCAL_WORTH_SAVING", worth_saving)
    graph = graph_with_focal(1.1)
    first_geometry(graph)
    assert graph.focal_is_free == is_free
    expected = CAMERA.fx if is_free else 1.1 * CAMERA.fx
    assert graph.grid.camera.fx == pytest.approx(expected, rel=0.01)


# A rolling shutter


class RolledFlow(TrueFlow):
    """The same flow, seen by a camera whose image is read in so many seconds."""

    graph: KeyframeGraph

    def __init__(self, readout: Readout) -> None:
        super().__init__()
        self.readout = readout

    def match(self, sources: list[int], targets: list[int], predicted: Tensor) -> FlowMatches:
        true = super().match(sources, targets, predicted)
        if not hasattr(self, "graph"):
            return true
        edges = list(zip(sources, targets, strict=True))
        columns = self.graph.shutter.columns(edges, true.targets)
        return replace(true, targets=true.targets - displacements(columns, self.readout))


def rolled_graph(readout: Readout) -> KeyframeGraph:
    """Return edges along the wall whose image moves as it does from frame to frame, 0.1 s each."""
    flow = RolledFlow(readout)
    graph = true_graph([0, 2, 4, 6, 8, 10], flow=flow)
    every = true_graph(list(range(FRAMES)))
    steps = [matches.targets[0] - every.grid.pixels.T for matches in every.flow_to_next]
    graph.shutter.motion.velocities = [step / 0.1 for step in (steps[0], *steps)]
    graph.shutter.motion.shortest_step = 0.1
    flow.graph = graph
    unrolled = range(len(graph.flow_to_next))
    graph.flow_to_next = [flow.match([k], [k + 1], every.grid.pixels.T[None]) for k in unrolled]
    return graph


@pytest.mark.slow
@pytest.mark.parametrize("readout", [(0.0, 0.0), (0.0, 0.06)])
def test_a_readout_is_found_with_the_first_geometry(readout: Readout):
    graph, truth = rolled_graph(readout), true_poses()[[0, 2, 4, 6, 8, 10]]
    first_geometry(graph)
    assert graph.shutter.readout == pytest.approx(readout, abs=1e-3)
    assert graph.shutter.is_found == any(readout)
    found = [poses[:, :3, 3] for poses in (graph.keyframes.T_camera_world, truth)]
    found = [centres / centres[-1].norm() for centres in found]
    assert float((found[0] - found[1]).abs().max()) < 1e-3


@pytest.mark.slow
def test_a_readout_longer_than_a_frames_time_is_none():
    graph = rolled_graph((0.0, 0.06))
    graph.shutter.motion.shortest_step = 0.05
    first_geometry(graph)
    seek_readouts(graph)
    assert not any(graph.shutter.readout) and not graph.shutter.is_found


@pytest.mark.slow
def test_an_image_counts_as_read_along_its_shorter_side():
    graph = rolled_graph((0.06, 0.0))  # along the longer one
    first_geometry(graph)
    seek_readouts(graph)
    assert not graph.shutter.is_found and not any(graph.shutter.readout)


# What is usual


def found_at(cost: float, log_focal: float = 0.0, slope: float = 1.0) -> Found:
    """Return a result of this cost whose disparities are so many times as large below as above."""
    ground = slope ** (GRID.pixels[:, 1] / CAMERA.height)
    state = BundleState(torch.eye(4).repeat(2, 1, 1), ground.repeat(2, 1), log_focal)
    return state, BundleReport(True, cost, cost, 1, 0.0)


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([found_at(90, math.log(2)), found_at(96, math.log(2))], 1),  # a doubling is worth 5 %
        ([found_at(96, math.log(2))], 0),
        ([found_at(96, math.log(0.5))], 0),
        ([found_at(104, slope=2.0)], 1),  # as is a ground, 10 % to none, 20 % to a ceiling
        ([found_at(112, slope=2.0)], 0),
        ([found_at(90, slope=0.5), found_at(104, slope=2.0)], 2),
        ([found_at(80, slope=0.5), found_at(104, slope=2.0)], 1),
        ([found_at(1, math.log(4.1)), found_at(1, math.log(0.24))], 0),  # a failed start
    ],
)
def test_of_nearly_equal_costs_the_usual_one_wins(others: list, expected: int):
    found = [found_at(100), *others]
    assert most_plausible(GRID, UNKNOWN, found) is found[expected]


def test_a_prior_says_what_is_usual():
    ceiling = 0.5 * torch.linspace(3, 1, CELLS).repeat(2, 1)
    ceiling[:, ::2] = 0  # half of it is not known
    ways = [found_at(100, slope=2.0), found_at(104, slope=0.5), found_at(110)]
    assert most_plausible(GRID, ceiling, ways) is ways[1]
    assert most_plausible(GRID, torch.zeros_like(ceiling), ways) is ways[0]
