"""A bent lens: its columns, what it costs the flow, and that a pinhole has none."""

import math
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.tracking.bundle_problem import BundleProblem
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards import lens as lens_module
from minislam.tracking.safeguards.lens import (
    BentLens,
    LensFit,
    _without_fold,
    bend_of,
    bends,
    check_lens,
    fit_lens,
    straightened,
    stretch,
    true_rays,
)
from tests.tracking.scene import CAMERA, RAYS, known_problem, normal
from tests.tracking.wall import GRID, disparities_at, true_graph, true_poses

NUMBERS = [*range(8)]
K1, K2 = -0.3, 0.1
BEND = -0.125867  # of a corner, from the root .710 of r (1 + K1 r^2 + K2 r^4) = .621


def tangents(positions: Tensor) -> Tensor:  # (..., 2) px
    centre = positions.new_tensor([CAMERA.cx, CAMERA.cy])
    return (positions - centre) / positions.new_tensor([CAMERA.fx, CAMERA.fy])


def pixels(u: Tensor) -> Tensor:
    focal, centre = u.new_tensor([CAMERA.fx, CAMERA.fy]), u.new_tensor([CAMERA.cx, CAMERA.cy])
    return focal * u + centre


def bent_graph(noise: float = 0.02):
    """Return the graph of a wall that is filmed through the lens, linked by its flow [px]."""
    graph, poses = true_graph(NUMBERS), true_poses()
    graph.match(neighbourhood_edges(0, len(NUMBERS), 3))
    u = true_rays(tangents(GRID.pixels).mT, (K1, K2)).mT
    rays = torch.cat([u, torch.ones_like(u[:, :1])], 1)
    sources, targets = torch.tensor(graph.edges.ends).unbind(1)
    disparities = torch.stack([disparities_at(poses[k], rays) for k in NUMBERS])
    motions = relative_transforms(poses[NUMBERS], sources, targets)
    positions, _ = reproject(motions, disparities[sources], rays, CAMERA)
    u_seen = tangents(positions.mT)
    seen = pixels(u_seen * stretch(u_seen.mT, (K1, K2)).mT).mT.float()
    graph.edges.targets = list(seen + noise * normal(5, *seen.shape).float())
    return graph


def bent_problem(radial: tuple[float, float]) -> tuple[BundleProblem, Tensor]:
    """Return cells and flow through a lens, straightened by `radial`, and what the pinhole misses.

    Each camera walks sideways before a wall, where the columns are exact.
    """
    motions = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motions[:, :2, 3] = torch.tensor([[0.6, -0.4], [-0.5, 0.7]])
    disparities = torch.full((2, len(RAYS)), 0.5, dtype=torch.float64)
    seen, _ = reproject(motions, disparities, RAYS, CAMERA)
    seen = seen + 3 * normal(1, *seen.shape)  # px
    problem = straightened(replace(known_problem(2).problem, targets=seen), radial)
    return problem, problem.targets - reproject(motions, disparities, problem.rays, CAMERA)[0]


def test_errors_that_straightening_spreads_weigh_less():
    problem, _ = bent_problem((K1, K2))
    before, _ = bent_problem((0.0, 0.0))
    distances = [(tangents(p.targets.mT) ** 2).sum(-1)[:, None] for p in (problem, before)]
    torch.testing.assert_close(problem.weights * distances[0], before.weights * distances[1])


def test_of_a_step_that_folds_the_image_a_part_is_taken():
    assert bend_of(CAMERA, (-9.0, 0.0)) <= -0.69
    k1, k2 = _without_fold(CAMERA, (0.0, 0.0), (-9.0, 0.0))
    assert -9 < k1 < -0.1 and k2 == 0 and bend_of(CAMERA, (k1, k2)) > -0.69
    assert _without_fold(CAMERA, (-0.1, 0.0), (-0.1, 0.1)) == (-0.2, 0.1)


def test_the_stretch_is_browns():
    u = torch.tensor([[0.3], [0.4]])
    assert stretch(u, (-0.2, 0.4)).item() == pytest.approx(1 - 0.2 * 0.25 + 0.4 * 0.0625)
    assert stretch(u, (-9.0, 0.0)).item() == pytest.approx(0.3)  # no lens folds its image


def test_what_k_lacks_moves_the_flow_along_the_columns():
    step, columns = 1e-5, bent_problem((K1, K2))[0].shift_columns
    assert columns.abs().amax((0, 2, 3)).min() > 1  # px: there is something to tell
    for n, more in enumerate([(step, 0.0), (0.0, step)]):
        ends = [bent_problem((K1 + sign * more[0], K2 + sign * more[1]))[1] for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        torch.testing.assert_close(columns[:, n], slope, rtol=1e-4, atol=1e-4)


def test_the_seen_ray_is_inverted():
    seen = tangents(GRID.pixels.double())
    u = true_rays(seen.mT, (K1, K2)).mT
    torch.testing.assert_close(u * stretch(u.mT, (K1, K2)).mT, seen, atol=1e-9, rtol=0)
    assert bend_of(CAMERA, (0.0, 0.0)) == 0 and abs(bend_of(CAMERA, (K1, K2)) - BEND) < 1e-6


@pytest.mark.parametrize("factor", [1.0, 1.25])  # of the focal length that is believed
def test_a_lens_that_bends_lines_is_told_from_the_flow(factor: float):
    graph = bent_graph()
    graph.grid.zoom(math.log(factor))
    fit = check_lens(graph, is_unknown=False)
    assert fit.is_worth_undoing and abs(fit.bend / BEND - 1) < 0.05  # measured: .973
    assert abs(fit.focal / CAMERA.fx - 1) < 0.02 and fit.saved > 0.7
    assert abs(fit.radial[0] - K1) < 0.02 and abs(fit.radial[1] - K2) < 0.02


def test_an_unknown_lens_that_bends_lines_asks_for_straightened_images():
    with pytest.raises(BentLens, match=r"by -12%: the run begins anew .* k1 = -0\.297") as bent:
        check_lens(bent_graph(), is_unknown=True)
    assert bent.value.lens == fit_lens(bent_graph())


def test_flow_that_fits_no_lens_does_not_fold_the_image():
    fit = fit_lens(bent_graph(noise=4.0))
    assert fit.bend > -0.7 and not fit.is_bent
    corner = torch.tensor([[0.9], [0.7]])
    assert true_rays(corner, (-3.0, 0.0)).isfinite().all() and bend_of(CAMERA, (-9.0, 0.0)) <= -0.5
    assert bends(CAMERA, corner, (-1 / (3 * 1.3), 0.0)).isfinite().all()


@pytest.mark.parametrize("factor", [1.0, 1.25])  # of the focal length that is believed
def test_a_pinhole_is_none(factor: float):
    graph = true_graph(NUMBERS)
    graph.match(neighbourhood_edges(0, len(NUMBERS), 3))
    graph.grid.zoom(math.log(factor))
    for index, target in enumerate(graph.edges.targets):
        graph.edges.targets[index] = target + 0.05 * normal(index, *target.shape).float()
    before = graph.keyframes.T_camera_world.clone()
    fit = fit_lens(graph)
    assert not fit.is_bent and abs(fit.bend) < 0.006
    assert torch.equal(graph.keyframes.T_camera_world, before)


def test_a_lens_is_undone_if_that_saves_much():
    def lens(bend: float, saved: float) -> LensFit:
        return LensFit(300.0, (bend, 0.0), bend, saved)

    for saved in (0.04, 0.12):
        for bent in lens(-0.05, saved), lens(0.05, saved):
            assert bent.is_bent and bent.is_worth_undoing == (saved > 0.1)
    assert not lens(-0.45, 0.12).is_worth_undoing  # nothing moves a corner so far
    for straight in lens(-0.05, 0.02), lens(0.03, 0.2), lens(0.12, 0.2):  # no lens bends out so
        assert not straight.is_bent and not straight.is_worth_undoing


def test_few_keyframes_and_no_links_tell_nothing():
    few = true_graph(NUMBERS[:3])
    few.match(neighbourhood_edges(0, 3, 2))
    assert few.edges.ends and fit_lens(few) is None
    assert fit_lens(true_graph(NUMBERS)) is None


@pytest.mark.parametrize(("widths", "is_undone"), [(0.2, False), (0.3, True)])
def test_a_fit_that_sees_136_degrees_has_failed(
    monkeypatch: pytest.MonkeyPatch, widths: float, is_undone: bool
):
    fit = LensFit(widths * CAMERA.width, (-0.2, 0.0), -0.2, 0.5)
    monkeypatch.setattr(lens_module, "fit_lens", lambda graph: fit)
    with pytest.raises(BentLens) if is_undone else nullcontext():
        assert check_lens(true_graph(NUMBERS), is_unknown=True) is fit
