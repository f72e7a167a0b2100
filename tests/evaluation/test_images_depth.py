import numpy as np
import pytest

from minislam.evaluation import depth_l1

REFERENCE = np.array([[2.0, 4.0, 0.0], [3.0, 5.0, 1.0]])


def test_the_mean_error_over_what_both_know():
    depth = np.array([[1.1, 0.0, 2.0], [1.5, 2.25, 0.5]])
    # Twice the map: 2.2, -, -, 3.0, 4.5, 1.0 against 2, -, -, 3, 5, 1.
    assert depth_l1(depth, REFERENCE, 2.0) == pytest.approx((0.2 + 0 + 0.5 + 0) / 4)


def test_movers_are_left_out():
    moving = np.array([[True, False, False], [False, True, False]])
    depth = np.array([[9.0, 4.5, 9.0], [3.0, 9.0, 1.0]])
    assert depth_l1(depth, REFERENCE, 1.0, moving) == pytest.approx(0.5 / 3)


def test_nothing_in_common_is_none():
    assert depth_l1(np.zeros((2, 3)), REFERENCE, 1.0) is None
    assert depth_l1(REFERENCE, REFERENCE, 1.0, np.ones((2, 3), bool)) is None


def test_other_sizes_are_refused():
    with pytest.raises(AssertionError):
        depth_l1(np.ones((3, 2)), REFERENCE, 1.0)
    with pytest.raises(AssertionError):
        depth_l1(REFERENCE, REFERENCE, 1.0, np.ones((3, 2), bool))
