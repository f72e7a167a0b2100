"""A bent lens: its columns, what it costs the flow, and that a pinhole has none."""

import math

import pytest
import torch
from torch import Tensor

from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards.lens import LensFit, check_lens, lens_columns
from tests.tracking.scene import CAMERA, RAYS, normal
from tests.tracking.wall import GRID, disparities_at, true_graph, true_poses

NUMBERS = [*range(8)]
K1, K2 = -0.3, 0.1
CORNER = (CAMERA.cx / CAMERA.fx) ** 2 + (CAMERA.cy / CAMERA.fy) ** 2
BEND = K1 * CORNER + K2 * CORNER**2


def stretch(u: Tensor, k1: float, k2: float) -> Tensor:  # (..., 2) tangents -> (..., 1)
    """Return how much farther from the centre the lens shows a ray."""
    squared = u.square().sum(-1, keepdim=True)
    return 1 + k1 * squared + k2 * squared**2


def unbent(seen: Tensor) -> Tensor:
    """Return the ray that the lens shows there, found by iteration."""
    u = seen
    for _ in range(50):
        u = seen / stretch(u, K1, K2)
    return u


def tangents(positions: Tensor) -> Tensor:  # (..., 2) px
    centre = positions.new_tensor([CAMERA.cx, CAMERA.cy])
    return (positions - centre) / positions.new_tensor([CAMERA.fx, CAMERA.fy])


def pixels(u: Tensor) -> Tensor:
    focal, centre = u.new_tensor([CAMERA.fx, CAMERA.fy]), u.new_tensor([CAMERA.cx, CAMERA.cy])
    return focal * u + centre


def bent_graph():
    """Return the graph of a wall that is filmed through the lens, linked by its true flow."""
    graph, poses = true_graph(NUMBERS), true_poses()
    graph.match(neighbourhood_edges(0, len(NUMBERS), 3))
    u = unbent(tangents(GRID.pixels.double()))
    rays = torch.cat([u, torch.ones_like(u[:, :1])], 1)
    sources, targets = torch.tensor(graph.links.edges).unbind(1)
    disparities = torch.stack([disparities_at(poses[k], rays) for k in NUMBERS])
    motions = relative_transforms(poses[NUMBERS], sources, targets)
    positions, _ = reproject(motions, disparities[sources], rays, CAMERA)
    u_seen = tangents(positions.mT)
    seen = pixels(u_seen * stretch(u_seen, K1, K2)).mT.float()
    graph.links.targets = list(seen + 0.05 * normal(5, *seen.shape).float())
    return graph


def test_the_columns_are_the_derivative_of_the_flow_by_the_lens():
    motions = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motions[:, :2, 3] = torch.tensor([[0.6, -0.4], [-0.5, 0.7]])  # sideways, before a wall
    disparities = torch.full((2, len(RAYS)), 0.5, dtype=torch.float64)
    positions, _ = reproject(motions, disparities, RAYS, CAMERA)
    columns = lens_columns(CAMERA, RAYS.double(), positions)
    assert columns.abs().amax((0, 2, 3)).min() > 1  # px: there is something to tell
    step = 1e-5
    for n, k in enumerate([(step, 0.0), (0.0, step)]):
        # From a cell that shows the ray u - k d(u), through the motion, to where the lens shows it.
        u = RAYS[:, :2].double()
        rays = torch.cat([u * (2 - stretch(u, *k)), torch.ones_like(u[:, :1])], 1)
        u_seen = tangents(reproject(motions, disparities, rays, CAMERA)[0].mT)
        change = (pixels(u_seen * stretch(u_seen, *k)).mT - positions) / step
        torch.testing.assert_close(-columns[:, n], change, rtol=1e-3, atol=1e-3)


def test_a_lens_that_bends_lines_is_told_from_the_flow():
    fit = check_lens(bent_graph())
    assert fit.is_bent and 0.5 < fit.bend / BEND < 0.7  # the poses bend, too (measured: .60)


@pytest.mark.parametrize("factor", [1.0, 1.25])  # of the focal length that is believed
def test_a_pinhole_is_none(factor: float):
    graph = true_graph(NUMBERS)
    graph.match(neighbourhood_edges(0, len(NUMBERS), 3))
    graph.grid.zoom(math.log(factor))
    for index, target in enumerate(graph.links.targets):
        graph.links.targets[index] = target + 0.05 * normal(index, *target.shape).float()
    before = graph.keyframes.T_camera_world.clone()
    fit = check_lens(graph)
    assert not fit.is_bent and abs(fit.bend) < 0.004
    assert torch.equal(graph.keyframes.T_camera_world, before)


def test_both_thresholds_count():
    assert LensFit(-0.05, 0.04).is_bent and LensFit(0.05, 0.04).is_bent
    assert not LensFit(-0.05, 0.02).is_bent and not LensFit(0.03, 0.2).is_bent


def test_few_keyframes_and_no_links_tell_nothing():
    few = true_graph(NUMBERS[:3])
    few.match(neighbourhood_edges(0, 3, 2))
    assert few.links.edges and check_lens(few) is None
    assert check_lens(true_graph(NUMBERS)) is None
