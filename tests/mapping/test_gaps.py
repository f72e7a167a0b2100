"""Gaps in a depth image are filled from around them; only what is static gets Gaussians there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from minislam.mapping.gaps import CELL, STIFFNESS, VOTERS, filled_depth, is_refuted, plate
from minislam.records import MapImage
from tests.mapping.plane_scene import CAMERA, make_mapper, wall_keyframe
from tests.pretended_gpu import GPU, pretended_gpu

COLUMN, ROW = torch.arange(64.0).expand(48, 64), torch.arange(48.0)[:, None].expand(48, 64)
PLANE = 1 / (0.1 + 0.002 * COLUMN + 0.005 * ROW)  # the depth of a tilted plane
INSIDE = (COLUMN > 11) & (COLUMN < 44) & (ROW > 15) & (ROW < 32)
GRAY = 0.5  # of all images


def test_a_gap_that_a_plane_surrounds_is_of_the_plane():
    filled = filled_depth(PLANE * ~INSIDE)
    torch.testing.assert_close(filled, PLANE, rtol=1e-5, atol=0)


def test_known_depth_stays_to_the_bit():
    depth = torch.where(COLUMN > 30, PLANE, 0)
    filled = filled_depth(depth)
    assert torch.equal(filled[depth > 0], PLANE[depth > 0]) and (filled > 0).all()
    assert torch.equal(filled_depth(PLANE), PLANE)


def test_without_any_depth_nothing_is_filled():
    assert not filled_depth(torch.zeros(48, 64)).any()


def test_beyond_the_last_known_depth_it_goes_on_alike():
    depth = torch.where(ROW < 20, 4.0, 0)
    torch.testing.assert_close(filled_depth(depth), torch.full_like(depth, 4.0))


def test_beyond_the_last_known_depth_a_plane_goes_on():
    known = ROW < 24
    filled = filled_depth(torch.where(known, PLANE, 0))
    near = ROW < 32  # farther on, 1/depth is cut off at 1.5 times the largest that is known
    torch.testing.assert_close(filled[near], PLANE[near], rtol=0.02, atol=0)
    assert filled.min() > PLANE[known].min() / 1.5 - 1e-4


def test_a_single_known_cell_is_continued_alike():
    values, known = np.zeros((4, 5)), np.zeros((4, 5), bool)
    values[1, 2], known[1, 2] = 0.7, True
    np.testing.assert_allclose(plate(values, known), 0.7, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 7), (5, 1), (6, 9)])
def test_no_other_plate_bends_less(shape: tuple[int, int]):
    generator = np.random.default_rng(3)
    values, known = generator.random(shape), generator.random(shape) < 0.6
    found = plate(values, known)

    def energy(f: np.ndarray) -> float:
        xx, yy, xy = np.diff(f, 2, 1), np.diff(f, 2, 0), np.diff(np.diff(f, axis=0), axis=1)
        bending = (xx**2).sum() + (yy**2).sum() + 2 * (xy**2).sum()
        return bending + STIFFNESS * ((f - values)[known] ** 2).sum()

    for cell in range(found.size):
        step = np.zeros(found.size)
        step[cell] = 1e-3
        up, down = (energy(found + sign * step.reshape(shape)) for sign in (1, -1))
        assert (up - down) / 2e-3 == pytest.approx(0, abs=1e-6)


def views(*depths: float) -> tuple[MapImage, ...]:
    """Return views from the origin along z, each of which knows one depth, or none (0)."""
    view = replace(wall_keyframe(0), T_camera_world=torch.eye(4, dtype=torch.float64))
    view = replace(view, pixels=torch.full_like(view.image, GRAY))
    return tuple(replace(view, depth=torch.full_like(view.depth, z)) for z in depths)


def refuted(
    points: torch.Tensor, own: MapImage, keyframes: Sequence[MapImage], shade: float = GRAY
) -> torch.Tensor:
    return is_refuted(points, torch.full_like(points, shade), CAMERA, own, keyframes)


@pytest.mark.parametrize(
    ("known", "hides"),
    [
        ((2.0,), True), ((2.0, 2.0, 1.0), True), ((2.0, 1.0), False), ((1.05,), False),
        ((1.15,), True), ((0.0,), False), ((0.5, 0.5), False), ((1.0, 2.0, 0.0, 2.0), True),
    ],
)  # fmt: skip
def test_a_point_hides_what_more_views_know_behind_it_than_at_it(known, hides: bool):
    points = torch.tensor([[0.0, 0.0, 1.0], [9.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert refuted(points, *views(0.0), views(*known)).tolist() == [hides, False, False]


def test_a_view_that_does_not_see_a_point_does_not_vote():
    [seeing], [other] = views(2.0), views(1.0)
    other.T_camera_world[0, 3] = 9.0
    assert refuted(torch.tensor([[0.0, 0.0, 1.0]]), *views(0.0), [seeing, other])


@pytest.mark.parametrize(("ahead", "aside", "left"), [(0.7, 0, 1), (0.5, 0, 0), (0.7, 9, 0)])
def test_a_guess_is_left_to_a_view_from_less_than_half_the_distance(ahead, aside, left):
    [own], [near] = views(0.0), views(0.0)
    near.T_camera_world[:3, 3] = torch.tensor([aside, 0, -ahead])
    point = torch.tensor([[0.0, 0.0, 1.0]])
    assert refuted(point, own, [own, near]).tolist() == [bool(left)]
    [own] = views(1.0)  # no guess
    assert not refuted(point, own, [own, near])


def test_of_many_views_every_nth_votes():
    point = torch.tensor([[0.0, 0.0, 1.0]])
    assert refuted(point, *views(0.0), views(2.0, 1.0, 1.0) * VOTERS)
    assert not refuted(point, *views(0.0), views(1.0, 2.0, 2.0) * VOTERS)


def test_what_its_own_keyframe_measures_stays():
    assert not refuted(torch.tensor([[0.0, 0.0, 1.0]]), *views(1.0), views(2.0))


@pytest.mark.parametrize(
    ("own", "known", "shade", "is_wrong"),
    [
        (1.0, (1.0,) * 3, 0.8, True), (1.0, (1.0,) * 3, 0.7, False),  # .3 and .2 off
        (0.0, (1.0,) * 3, 0.8, True), (1.0, (0.0,) * 3, 0.2, True),
        (1.0, (1.0,) * 2, 0.8, False),  # two views are too few
        (1.0, (0.5,) * 3, 0.8, False), (1.0, (0.95,) * 3, 0.8, True),  # hidden or not
    ],
)  # fmt: skip
def test_a_point_that_most_views_see_in_another_color_is_refuted(own, known, shade, is_wrong):
    point = torch.tensor([[0.0, 0.0, 1.0]])
    assert bool(refuted(point, *views(own), views(*known), shade)) is is_wrong


def test_as_many_views_that_see_its_color_save_a_point():
    point, seen = torch.tensor([[0.0, 0.0, 1.0]]), views(*(1.0,) * 6)
    bright = [replace(view, pixels=torch.full_like(view.image, 0.8)) for view in seen]
    assert refuted(point, *views(1.0), [*seen[:3], *bright[:4]])
    assert not refuted(point, *views(1.0), [*seen[:3], *bright[:3]])
    dark = [replace(view, exposure=torch.full((3,), 1.6)) for view in bright]  # .5, levelled
    assert not refuted(point, *views(1.0), dark)


def test_on_a_gpu_it_is_filled_as_on_the_cpu():
    depth = PLANE * ~INSIDE
    with pretended_gpu():
        filled = filled_depth(depth.to(GPU))
        assert filled.device.type == GPU
        assert torch.equal(filled.cpu(), filled_depth(depth))


def test_an_image_of_any_size_is_filled():
    depth = torch.full((4 * CELL + 3, 5 * CELL + 1), 2.0)
    depth[-3:, -1:] = 0
    torch.testing.assert_close(filled_depth(depth), torch.full_like(depth, 2.0))


@pytest.mark.slow
@pytest.mark.parametrize("moves", [False, True])
def test_a_static_gap_is_in_the_map_and_a_moving_one_is_not(moves: bool):
    keyframe, mapper = wall_keyframe(1), make_mapper()
    gap = torch.zeros_like(keyframe.depth, dtype=torch.bool)
    gap[6:18, 6:26] = True
    keyframe.depth[gap] = 0
    mapper.initialise([replace(keyframe, moving_mask=gap if moves else None)])
    inside = slice(10, 14), slice(12, 20)
    before = mapper.render(keyframe.T_camera_world).opacity[inside]
    mapper.refine(8)
    after = mapper.render(keyframe.T_camera_world)
    assert before.mean() < 0.5
    assert (after.opacity[inside].mean() > 0.8) != moves
    if not moves:
        surface = (after.depth / after.opacity)[inside]
        torch.testing.assert_close(surface, torch.full_like(surface, 2.0), rtol=0.05, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("knows", [False, True])
def test_what_would_hide_the_surface_that_another_view_knows_is_not_filled(knows: bool):
    keyframe, mapper = wall_keyframe(1), make_mapper()
    near = replace(keyframe, depth=torch.ones_like(keyframe.depth))
    near.depth[6:18, 6:26] = 0
    wall = keyframe.depth if knows else torch.zeros_like(keyframe.depth)
    mapper.initialise([near, replace(keyframe, depth=wall, inserts=False)])
    mapper.refine(8)
    inside = mapper.render(keyframe.T_camera_world).opacity[10:14, 12:20]
    assert (inside.mean() > 0.8) != knows
