"""A drift of the scale: a known one is undone, and what the prior may err itself is left alone."""

from types import SimpleNamespace

import pytest
import torch
from pytest import MonkeyPatch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.safeguards import scale_drift
from minislam.tracking.safeguards.scale_drift import step_ratios, told_drift, undo_scale_drift
from tests.helpers import generator
from tests.tracking.wall import true_graph

CELLS, KEYFRAMES = 60, 120


def walk() -> Tensor:
    """Return true poses (K, 4, 4): a way with turns."""
    source = generator(0)
    twists = 0.05 * torch.randn(KEYFRAMES, 6, generator=source, dtype=torch.float64)
    twists[:, 2] += 0.1
    poses = [torch.eye(4, dtype=torch.float64)]
    for twist in twists[1:]:
        poses.append(se3_exp(twist) @ poses[-1])
    return torch.stack(poses)


def store_with(drift: Tensor) -> KeyframeStore:
    """Return keyframes whose lengths are exp(-drift) of the true ones."""
    true = 0.2 + torch.rand(KEYFRAMES, CELLS, generator=generator(1))
    keyframes = KeyframeStore(true[0])
    keyframes.set_geometry(shortened(walk(), drift), true * drift.exp().float()[:, None])
    keyframes.prior_disparities = true
    return keyframes


def steps_with(drift: Tensor, noise: float = 0.0, every: int = 1) -> tuple[Tensor, Tensor]:
    """Return what `step_ratios` finds if every n-th step has a prior that errs by `noise`."""
    draw = torch.randn(KEYFRAMES - 1, generator=generator(2), dtype=torch.float64)
    information = torch.zeros(KEYFRAMES - 1, dtype=torch.float64)
    information[::every] = 100.0
    return (drift[1:] + drift[:-1]) / 2 + noise * draw, information


def undone(keyframes: KeyframeStore, steps: tuple[Tensor, Tensor], patch: MonkeyPatch) -> None:
    patch.setattr(scale_drift, "step_ratios", lambda graph: steps)
    undo_scale_drift(SimpleNamespace(keyframes=keyframes))


def shortened(T_camera_world: Tensor, drift: Tensor) -> Tensor:
    poses = se3_inverse(T_camera_world)
    steps = poses[:, :3, 3].diff(dim=0) * ((-drift[1:] - drift[:-1]) / 2).exp()[:, None]
    poses[1:, :3, 3] = poses[0, :3, 3] + steps.cumsum(0)
    return se3_inverse(poses)


def bend(size: float) -> Tensor:
    """Return a drift (K,) of this standard deviation, 0 in the mean."""
    line = torch.linspace(-1, 1, KEYFRAMES, dtype=torch.float64)
    return size * (line - line.mean()) / line.std()


def centre_error(keyframes: KeyframeStore) -> float:
    centres = se3_inverse(keyframes.T_camera_world)[:, :3, 3]
    truth = se3_inverse(walk())[:, :3, 3]
    centres, truth = centres - centres.mean(0), truth - truth.mean(0)
    scale = (centres * truth).sum() / centres.square().sum()
    return float((scale * centres - truth).norm() / truth.norm())


def wall_with_prior(factors: list[float]) -> KeyframeGraph:
    """Return the first frames before a wall; the prior depth of each is its factor times true."""
    graph = true_graph(list(range(len(factors))))
    prior = graph.keyframes.disparities / torch.tensor(factors)[:, None]
    graph.keyframes.prior_disparities = prior.float()
    graph.match(neighbourhood_edges(0, len(factors), 1))
    return graph


def test_a_step_has_the_length_that_the_prior_of_its_ends_gives_it():
    graph = wall_with_prior([1.1, 1.1, 1.0, 0.9])
    T_world_camera = se3_inverse(graph.keyframes.T_camera_world)
    T_world_camera[:, :3, 3] *= 0.8  # all steps are estimated too short
    T_world_camera[3:, :3, 3] += T_world_camera[3, :3, 3] - T_world_camera[2, :3, 3]  # or too long
    graph.keyframes.T_camera_world = se3_inverse(T_world_camera)
    ratios, information = step_ratios(graph)
    expected = torch.tensor([1.1 / 0.8, 1.05 / 0.8, 0.95 / 1.6], dtype=torch.float64).log()
    torch.testing.assert_close(ratios, expected, atol=0.02, rtol=0)
    assert (information > 0).all()


def test_its_information_is_the_inverse_variance_under_noise_of_the_flow():
    graph, found = wall_with_prior([1.0] * 4), []
    exact, sigma = [targets.clone() for targets in graph.edges.targets], 0.2
    for seed in range(60):
        source = generator(seed)
        for k, targets in enumerate(exact):
            graph.edges.targets[k] = targets + sigma * torch.randn(targets.shape, generator=source)
        ratios, information = step_ratios(graph)
        found.append(ratios)
    expected = sigma**2 / information
    torch.testing.assert_close(torch.stack(found).var(0), expected, rtol=0.6, atol=0)


def test_steps_without_a_prior_or_without_flow_tell_nothing():
    graph = wall_with_prior([1.0] * 5)
    graph.keyframes.prior_disparities[:2] = 0
    for position, (source, target) in enumerate(graph.edges.ends):
        if {source, target} == {3, 4}:
            graph.edges.confidences[position] = torch.zeros_like(graph.edges.confidences[position])
    ratios, information = step_ratios(graph)
    assert information[0] == 0 and ratios[0] == 0  # neither end has a prior
    assert information[3] < 1e-6 * information[2] and torch.isfinite(ratios).all()


def test_a_graph_without_a_prior_stays_as_it_is():
    graph = true_graph([0, 1, 2])
    before = graph.keyframes.T_camera_world
    undo_scale_drift(graph)
    assert graph.keyframes.T_camera_world is before


def test_a_step_that_hardly_any_flow_tells_does_not_count():
    drift = bend(0.2)
    ratios, information = steps_with(drift)
    expected = told_drift(ratios, information)
    ratios[50:60], information[50:60] = -3.0, 1e-6
    assert (told_drift(ratios, information) - expected).abs().max() < 0.02


def test_a_drift_is_told_but_for_the_part_that_the_prior_may_err():
    drift = bend(0.2)
    found = told_drift(*steps_with(drift))
    kept = float(found @ drift / drift.square().sum())
    assert kept == pytest.approx(1 - 0.03**2 / 0.2**2, abs=0.05)  # less what the ends lose
    assert (found - kept * drift).abs().max() < 0.06


def test_undoing_it_brings_steps_and_depths_back_and_keeps_all_turns(monkeypatch: MonkeyPatch):
    keyframes = store_with(bend(0.2))
    before, turns = centre_error(keyframes), keyframes.T_camera_world[:, :3, :3].clone()
    undone(keyframes, steps_with(bend(0.2), noise=0.05), monkeypatch)
    assert centre_error(keyframes) < 0.25 * before
    torch.testing.assert_close(keyframes.T_camera_world[:, :3, :3], turns)
    ratio = (keyframes.disparities / store_with(bend(0.0)).disparities).log()
    assert ratio.mean(1).std() < 0.05
    assert torch.equal(keyframes.T_camera_world[0], walk()[0])  # the first camera is the world


def test_steps_and_disparities_stay_consistent(monkeypatch: MonkeyPatch):
    """What a pair of neighbours sees of each other does not change: t d is the same."""
    keyframes = store_with(bend(0.2))
    drift = told_drift(*steps_with(bend(0.2)))
    centres, disparities = se3_inverse(keyframes.T_camera_world)[:, :3, 3], keyframes.disparities
    undone(keyframes, steps_with(bend(0.2)), monkeypatch)
    new = se3_inverse(keyframes.T_camera_world)[:, :3, 3]
    relative = (new.diff(dim=0).norm(dim=1) / centres.diff(dim=0).norm(dim=1)).log()
    torch.testing.assert_close(relative, (drift[1:] + drift[:-1]) / 2)
    change = (keyframes.disparities / disparities).log().double()
    torch.testing.assert_close(change, -drift[:, None].expand_as(change), atol=1e-5, rtol=0)


@pytest.mark.parametrize("every", [1, 20])
@pytest.mark.parametrize("size", [0.0, 0.02])
def test_a_drift_that_the_prior_may_have_itself_is_left_alone(
    size: float, every: int, monkeypatch: MonkeyPatch
):
    keyframes = store_with(bend(size))
    before = keyframes.T_camera_world, keyframes.disparities
    undone(keyframes, steps_with(bend(size), noise=0.05, every=every), monkeypatch)
    assert keyframes.T_camera_world is before[0] and keyframes.disparities is before[1]


def test_few_steps_with_a_prior_tell_a_large_drift(monkeypatch: MonkeyPatch):
    keyframes = store_with(bend(0.2))
    before = centre_error(keyframes)
    undone(keyframes, steps_with(bend(0.2), every=5), monkeypatch)
    assert centre_error(keyframes) < 0.4 * before


def test_a_prior_for_a_small_part_of_a_long_run_tells_a_finite_drift():
    ratios, information = torch.linspace(-0.3, 0.3, 600).double(), torch.zeros(600).double()
    information[:60] = 400.0
    found = told_drift(ratios, information)
    assert torch.isfinite(found).all()
    assert (found[100:] - found[-1]).abs().max() < 1e-9  # as the nearest step that is told


def test_one_step_or_none_tells_nothing():
    ratios, information = steps_with(bend(0.2), every=KEYFRAMES)
    assert not told_drift(ratios, information).any()
    assert not told_drift(ratios, torch.zeros_like(information)).any()


def test_a_step_whose_prior_has_gaps_tells_as_much():
    graph = wall_with_prior([1.1, 1.1, 1.1])
    graph.keyframes.prior_disparities[:, ::3] = 0  # sky, glass
    ratios, information = step_ratios(graph)
    torch.testing.assert_close(ratios.exp(), torch.full_like(ratios, 1.1), atol=0.02, rtol=0)
    assert (information > 0).all()
