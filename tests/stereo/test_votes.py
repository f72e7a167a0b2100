"""Votes on a wall: true depths are confirmed, wrong ones are not, near ones are refuted."""

import numpy as np
import pytest

from minislam.geometry import Camera
from minislam.stereo import votes
from minislam.stereo.votes import (
    MOST_SPREAD,
    ConfirmedDepth,
    SweptView,
    confirm,
    keep_what_stays,
    vote,
)

CAMERA = Camera(fx=60.0, fy=66.0, cx=19.5, cy=14.5, width=40, height=30)
WALL = 0.5  # inverse depth


def view(shift: float = 0.0, inverse_depth: float = WALL, cost: float = 0.1) -> SweptView:
    """Return what a camera sees that has moved sideways along the wall."""
    pose = np.eye(4)
    pose[0, 3] = -shift
    shape = (CAMERA.height, CAMERA.width)
    found = np.full(shape, inverse_depth, np.float32)
    return SweptView(found, np.full(shape, cost, np.float32), 0.01, pose)


def others(count: int = 4, **kind: float) -> list[SweptView]:
    return [view(0.05 * (k + 1), **kind) for k in range(count)]


def with_square(swept: SweptView, inverse_depth: float) -> SweptView:
    swept.inverse_depth[10:20, 10:20] = inverse_depth
    return swept


def confirmed(swept: SweptView, voters: list[SweptView]) -> ConfirmedDepth:
    return confirm(CAMERA, swept, voters)


def test_the_wall_is_confirmed():
    result = confirmed(view(), others())
    inner = (slice(4, -4), slice(8, -8))
    assert (result.inverse_depth[inner] == np.float32(WALL)).all()
    np.testing.assert_allclose(result.confirmation[inner], 1, atol=1e-6)


def test_a_depth_that_nobody_else_finds_is_unknown():
    result = confirmed(with_square(view(), 0.8), others())
    assert (result.inverse_depth[11:19, 11:19] == 0).all()
    assert result.confirmation[13:17, 13:17].max() == 0
    assert (result.inverse_depth[4:8, 8:-8] > 0).all()


def test_a_depth_goes_on_so_far_from_a_good_match_and_no_farther():
    swept = view()
    swept.cost[:, 20:] = 0.9  # a plain wall at the right, joined to what matches at its left
    result = confirmed(swept, others())
    last = 19 + int(MOST_SPREAD * CAMERA.width)
    assert (result.inverse_depth[4:-4, 8 : last + 1] > 0).all()
    assert (result.inverse_depth[:, last + 1 :] == 0).all()
    swept.cost[14, 30] = 0.1  # one match in it: around it, a disc
    rows, columns = np.nonzero(confirmed(swept, others()).inverse_depth[:, 25:])
    assert np.hypot(rows - 14, columns - 5).max() == MOST_SPREAD * CAMERA.width == 3


def test_a_view_that_looks_through_a_point_refutes_it():
    near = with_square(view(), 0.8)
    agrees, refutes = vote(CAMERA, near, view(0.1))
    assert refutes[10:20, 10:20].all() and not agrees[10:20, 10:20].any()
    assert agrees[:5, 8:].all() and not refutes[:5].any()


def test_a_view_in_front_of_a_point_does_not_refute_it():
    far = with_square(view(), 0.3)  # a covered point, seen through the wall
    agrees, refutes = vote(CAMERA, far, view(0.1))
    assert not refutes.any() and not agrees[10:20, 10:20].any()


def test_a_view_that_looks_a_little_too_far_neither_agrees_nor_refutes():
    near = view(inverse_depth=0.05)  # planes are 0.01 apart
    agrees, refutes = vote(CAMERA, near, view(0.1, inverse_depth=0.035))
    assert not agrees.any() and not refutes.any()
    assert vote(CAMERA, near, view(0.1, inverse_depth=0.025))[1][:, 2:-2].all()


def test_a_badly_matched_view_cannot_refute():
    assert not vote(CAMERA, with_square(view(), 0.8), view(0.1, cost=0.9))[1].any()


def test_one_plane_of_error_still_agrees():
    agrees, _ = vote(CAMERA, view(inverse_depth=0.02), view(0.1, inverse_depth=0.029))
    assert agrees[:, 2:-2].all()


def test_a_view_outside_of_the_other_image_has_no_vote():
    agrees, refutes = vote(CAMERA, view(), view(100.0))
    assert not agrees.any() and not refutes.any()


def test_too_few_votes_are_not_enough():
    assert (confirmed(view(), others(2) + others(1, inverse_depth=0.9)).inverse_depth == 0).all()
    assert (confirmed(view(), []).inverse_depth == 0).all()
    assert (confirmed(view(), others(2)).inverse_depth[4:-4, 8:-8] > 0).all()  # all there are


def test_what_matches_badly_is_known_but_confirms_nothing():
    stripes = view()
    stripes.cost[:, 20:] = 0.7
    stripes.cost[:, 20::4] = 0.1
    result = confirmed(stripes, others())
    assert (result.inverse_depth[4:-4, 8:-8] > 0).all()
    assert result.confirmation[:, 24:28].max() < 0.5 < 0.99 < result.confirmation[6:24, 12:16].min()


def test_if_nothing_matches_well_nothing_is_known():
    assert confirmed(view(cost=0.7), others()).inverse_depth.max() == 0


def test_where_the_sweep_found_nothing_there_is_no_vote():
    lost = with_square(view(), np.nan)
    result = confirmed(lost, others())
    assert (result.inverse_depth[10:20, 10:20] == 0).all()
    agrees, refutes = vote(CAMERA, view(), lost)
    assert not agrees[12:18, 12:18].any() and not refutes[12:18, 12:18].any()


# What stands still for a while


def of_time(time: int, stands: bool) -> tuple[SweptView, ConfirmedDepth]:
    """Return a view of the wall, and its confirmed depth. A box may stand before the wall.

    The camera hardly moves, so that the box stays at its pixels.
    """
    swept = with_square(view(0.001 * time), 0.8) if stands else view(0.001 * time)
    return swept, ConfirmedDepth(swept.inverse_depth.copy(), np.ones_like(swept.cost))


def kept(stands: list[bool]) -> list[ConfirmedDepth]:
    views, depths = zip(*(of_time(*at) for at in enumerate(stands)), strict=True)
    return [*keep_what_stays(CAMERA, list(views), list(depths), list(range(len(views))))]


BOX, INNER_BOX = np.s_[10:20, 10:20], np.s_[13:17, 13:17]


@pytest.mark.parametrize("before, after", [(6, 4), (8, 2)])
def test_a_box_that_leaves_is_dropped_though_all_views_before_confirm_it(before: int, after: int):
    depths = kept([True] * before + [False] * after)
    for depth in depths[:before]:
        assert (depth.inverse_depth[INNER_BOX] == 0).all()
        assert (depth.confirmation[INNER_BOX] == -1).all()
        assert (depth.inverse_depth[24:, :] == np.float32(WALL)).all()
        np.testing.assert_allclose(depth.confirmation[26:], 1, atol=1e-6)


def test_the_wall_at_the_edge_of_a_box_that_leaves_is_kept():
    for depth in kept([True] * 6 + [False] * 4)[:6]:
        rim = depth.inverse_depth[7:10, 8:22]
        assert (rim[rim > 0] == np.float32(WALL)).all() and (rim > 0).mean() > 0.9
        assert (depth.confirmation[depth.inverse_depth > 0] >= 0).all()


def test_a_surface_is_judged_by_all_its_pixels_around():
    # Three views look through a sixth of the box, which the other five of its time confirm.
    views, depths = zip(*(of_time(k, True) for k in range(9)), strict=True)
    for depth in depths[6:]:
        depth.inverse_depth[10:12, 10:18] = WALL
    (first,) = keep_what_stays(CAMERA, list(views), list(depths), [0])
    assert (first.inverse_depth[BOX] == np.float32(0.8)).all()
    assert first.confirmation.min() > 1 - 1e-6


def test_pixels_without_depth_do_not_thin_the_votes_against_an_object():
    views, depths = zip(*(of_time(k, k < 6) for k in range(10)), strict=True)
    for depth in depths[:6]:
        outside = depth.inverse_depth == np.float32(WALL)
        depth.inverse_depth[outside] = 0
    (first,) = keep_what_stays(CAMERA, list(views), list(depths), [0])
    assert first.inverse_depth.max() == 0 and (first.confirmation[INNER_BOX] == -1).all()


def test_no_view_has_a_vote_on_itself(monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []
    none = np.zeros_like(view(0.0).cost)
    monkeypatch.setattr(
        votes, "count_votes", lambda camera, of, others: asked.append(len(others)) or (none, none)
    )
    kept([True] * 5)
    assert asked == [4] * 5


def test_the_wall_behind_a_box_that_leaves_is_kept():
    for depth in kept([True] * 6 + [False] * 4)[6:]:
        assert (depth.inverse_depth == np.float32(WALL)).all()
        np.testing.assert_allclose(depth.confirmation, 1, atol=1e-6)


def test_a_box_that_stays_is_kept_although_one_view_in_ten_misses_it():
    for stands in ([True] * 10, [True] * 9 + [False]):
        depth = kept(stands)[0]
        assert (depth.inverse_depth[BOX] == np.float32(0.8)).all()
        assert depth.confirmation.min() > 1 - 1e-6


def test_depths_that_nothing_confirms_do_not_judge():
    views, depths = zip(*(of_time(k, k < 3) for k in range(9)), strict=True)
    doubtful = [
        depth if k < 3 else ConfirmedDepth(depth.inverse_depth, 0 * depth.confirmation)
        for k, depth in enumerate(depths)
    ]
    (first,) = keep_what_stays(CAMERA, list(views), doubtful, [0])
    assert (first.inverse_depth[BOX] == np.float32(0.8)).all()


def test_views_that_know_nothing_are_kept_as_they_are():
    empty = ConfirmedDepth(np.zeros_like(view().cost), np.zeros_like(view().cost))
    for depth in keep_what_stays(CAMERA, others(), [empty] * 4, [0, 3]):
        assert depth.inverse_depth.max() == 0 and depth.confirmation.max() == 0
