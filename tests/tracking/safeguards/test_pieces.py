"""Stretches between breaks and losses, and the edges that tie them."""

import pytest

from minislam.geometry import se3_exp
from minislam.tracking.frame_graph import both_directions
from minislam.tracking.safeguards.pieces import edges_past_a_loss, found_again, pieces
from tests.tracking.test_loop_closure import CONFIG
from tests.tracking.wall import TrueFlow, true_graph

FRAMES = [0, 10, 20, 30, 40, 50, 60, 70]


def test_without_a_loss_each_segment_is_a_piece_though_edges_cross_the_break():
    crossing = [(1, 3), (3, 1), (0, 1)]
    assert pieces(FRAMES, [(0, 10), (30, 70)], [], crossing) == [[(0, 10)], [(30, 70)]]


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
    assert pieces(FRAMES, [(0, 20), (40, 70)], [6], [edge]) == expected


def test_two_edges_tie_three_stretches():
    assert pieces(FRAMES, [(0, 70)], [3, 6], [(4, 1), (7, 3)]) == [[(0, 29), (30, 59), (60, 70)]]


@pytest.mark.parametrize("is_learned", [False, True])
def test_only_edges_past_a_loss_that_fit_tie(is_learned: bool):
    graph = true_graph([0, 1, 2, 3], CONFIG, TrueFlow(is_learned=is_learned))
    edges = both_directions([(1, 0), (2, 1), (3, 1), (3, 2)])
    graph.match(edges)
    graph.flow_to_next = [object(), None, object()]
    assert found_again(graph) == [2]
    assert edges_past_a_loss(graph) == both_directions([(2, 1), (3, 1)])
    graph.keyframes.T_camera_world[3] @= se3_exp(graph.keyframes.T_camera_world.new_ones(6))
    assert edges_past_a_loss(graph) == both_directions([(2, 1)])
    graph.flow_to_next = [object(), object(), object()]
    assert edges_past_a_loss(graph) == []
