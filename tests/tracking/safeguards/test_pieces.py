"""Stretches between breaks and losses, and the edges that tie them."""

import pytest

from minislam.tracking.safeguards.pieces import pieces

FRAMES = [0, 10, 20, 30, 40, 50, 60, 70]


def test_without_a_loss_each_segment_is_a_piece_though_edges_cross_the_break():
    crossing = [(1, 3), (3, 1), (0, 1)]
    assert pieces(FRAMES, [(0, 10), (30, 70)], set(), crossing) == [[(0, 10)], [(30, 70)]]


@pytest.mark.parametrize(
    ("edge", "expected"),
    [
        ((6, 1), [[(0, 20), (60, 70)], [(40, 59)]]),  # found again at the first piece
        ((6, 5), [[(0, 20)], [(40, 59), (60, 70)]]),  # and at the second
        ((0, 2), [[(0, 20)], [(40, 59)], [(60, 70)]]),
        ((6, 3), [[(0, 20)], [(40, 59)], [(60, 70)]]),  # keyframe 3 is in the break
    ],
)
def test_behind_a_loss_edges_tell_where_a_stretch_belongs(edge: tuple[int, int], expected: list):
    assert pieces(FRAMES, [(0, 20), (40, 70)], {6}, [edge]) == expected


def test_two_edges_tie_three_stretches():
    assert pieces(FRAMES, [(0, 70)], {3, 6}, [(4, 1), (7, 3)]) == [[(0, 29), (30, 59), (60, 70)]]
