import pytest
import torch

from minislam.mapping.window import (
    in_turn,
    overlap_coefficient,
    sampling_probabilities,
    update_window,
)
from tests.mapping.plane_scene import pose


def seen(*indices: int) -> torch.Tensor:
    mask = torch.zeros(10, dtype=torch.bool)
    mask[list(indices)] = True
    return mask


def poses(*shifts: float) -> torch.Tensor:
    return torch.stack([pose(shift) for shift in shifts])


# Known answers


def test_overlap_by_hand():
    assert overlap_coefficient(seen(0, 1, 2), seen(1, 2, 3, 4)) == pytest.approx(2 / 3)


def test_the_oldest_keyframe_without_overlap_leaves_and_only_that_one():
    views = {k: seen(0, 1) for k in range(6)} | {0: seen(8), 2: seen(9), 5: seen(0, 1)}
    window = update_window([4, 3, 2, 1, 0], 5, views, poses(*range(6)), 10)
    assert window == [5, 4, 3, 2, 1]


def test_the_two_newest_never_leave():
    views = {0: seen(8), 1: seen(9)}
    assert update_window([0], 1, views, poses(0, 1), 3) == [1, 0]


def test_a_full_window_drops_a_keyframe_that_is_far_and_close_to_another():
    # Positions 0 and 1 stand together, far from the new one at 10.
    shifts = [0.0, 0.1, 5.0, 9.0, 10.0]
    views = {k: seen(0, 1) for k in range(5)}
    window = update_window([3, 2, 1, 0], 4, views, poses(*shifts), 4)
    assert window in ([4, 3, 2, 0], [4, 3, 2, 1])


@pytest.mark.parametrize(
    ("count", "share", "inside", "outside"),
    [
        (30, 0.5, 0.05, 0.025),
        (30, 0.7, 0.07, 0.015),
        (13, 0.5, 1 / 13, 1 / 13),
        (20, 0.5, 0.05, 0.05),
        (10, 1.0, 0.1, 0.1),
    ],
)
def test_sampling_of_a_window_of_ten(count, share, inside, outside):
    probabilities = sampling_probabilities(count, list(range(10)), share)
    assert float(probabilities.sum()) == pytest.approx(1)
    assert float(probabilities[0]) == pytest.approx(inside)
    assert float(probabilities[-1]) == pytest.approx(outside)


# Degenerate input


def test_a_window_of_all_keyframes_is_uniform_and_finite():
    assert sampling_probabilities(1, [0], 0.5).tolist() == [1.0]
    assert sampling_probabilities(10, list(range(10)), 0.5).tolist() == pytest.approx([0.1] * 10)


def test_nothing_seen_is_no_overlap():
    assert overlap_coefficient(seen(), seen(1)) == 0.0


def test_keyframes_at_one_place_do_not_divide_by_zero():
    views = {k: seen(0) for k in range(5)}
    assert len(update_window([3, 2, 1, 0], 4, views, poses(*[0.0] * 5), 4)) == 4


def test_the_window_never_exceeds_its_size():
    window, views = [0], {k: seen(0) for k in range(40)}
    for new in range(1, 40):
        window = update_window(window, new, views, poses(*range(40)), 10)
        assert len(window) == min(new + 1, 10) and window[0] == new


# Keyframes in turn


def test_each_round_renders_every_keyframe_once_in_an_order_of_its_own():
    drawn = in_turn(range(30), 10, seed=0)
    rounds = [drawn[start : start + 10] for start in range(0, 30, 10)]
    assert all(sorted(one) == list(range(10)) for one in rounds)
    assert rounds[0] != rounds[1] != rounds[2]
    assert in_turn(range(10), 10, seed=1) != rounds[0]


def test_a_part_of_the_iterations_is_as_in_the_whole():
    assert in_turn(range(7, 23), 10, seed=3) == in_turn(range(30), 10, seed=3)[7:23]
    assert in_turn(range(4), 1, seed=0) == [0] * 4


def test_of_two_that_stand_together_the_crowded_one_leaves_not_the_farthest():
    # The candidates stand at 0, 5 and 5.1, the new keyframe at 10: alone, the farthest stays.
    views = {k: seen(0, 1) for k in range(5)}
    window = update_window([3, 2, 1, 0], 4, views, poses(0.0, 5.0, 5.1, 9.0, 10.0), 4)
    assert window in ([4, 3, 1, 0], [4, 3, 2, 0])


def test_of_two_that_stand_as_close_to_others_the_one_far_from_the_new_leaves():
    views = {k: seen(0, 1) for k in range(5)}
    window = update_window([3, 2, 1, 0], 4, views, poses(0.4, -0.5, 0.1, 5.0, 0.0), 4)
    assert window == [4, 3, 2, 1]  # score 2.8 at 0.4, but 1.6 at 0.1, which is the most crowded
