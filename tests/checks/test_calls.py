"""A student's function is called on copies, for a limited time, and its stop is told."""

import sys
import time

import pytest
import torch

from minislam.checks.calls import Stopped, call, time_limit
from minislam.geometry import Camera


def test_changes_in_place_do_not_reach_the_case():
    mine, rows = torch.ones(2), [1, 2]

    def spoil(tensor, rows):
        tensor.zero_()
        rows.clear()
        return 0

    call(spoil, (mine, rows), 5.0)
    assert mine.sum() == 2 and rows == [1, 2]


def test_tensors_come_in_the_notebooks_dtype_and_else_as_they_are():
    given = torch.ones(2, dtype=torch.float64), torch.tensor([1])
    assert call(lambda x, i: (x.dtype, i.dtype), given, 5.0)[0] == (torch.float32, torch.int64)
    ones = torch.ones(2, dtype=torch.float64)
    answer, given = call(lambda x, i: ones @ x, given, 5.0)  # mixes dtypes at first
    assert answer == 2 and given[0].dtype == torch.float64


def test_a_stop_tells_the_line_of_the_student():
    def wrong(x):
        y = x + 1
        return torch.linalg.inv(y)

    with pytest.raises(Stopped) as stop:
        call(wrong, (torch.ones(2),), 5.0)
    assert str(stop.value).startswith("stops with RuntimeError: ")
    assert str(stop.value).endswith("return torch.linalg.inv(y)")
    assert ", in line " in str(stop.value)
    with pytest.raises(Stopped, match="stops with SystemExit: 3, in line"):
        call(lambda: sys.exit(3), (), 5.0)
    with pytest.raises(Stopped, match=r"fx=-1.*, in line \d+: camera = Camera"):
        call(with_a_wrong_camera, (), 5.0)
    with pytest.raises(NotImplementedError):
        call(unwritten, (), 5.0)
    with pytest.raises(Stopped, match=r"NotImplementedError: .*Bool.*, in line .*mask @ mask"):
        call(lambda mask: mask @ mask, (torch.ones(2, 2) > 0,), 5.0)


def with_a_wrong_camera():
    camera = Camera(-1.0, 1.0, 1.0, 1.0, 2, 2)
    return camera.fx


def unwritten():
    raise NotImplementedError


@pytest.mark.slow
def test_an_endless_loop_ends():
    def endless():
        while True:
            pass

    with pytest.raises(Stopped, match=r"no answer after 0\.2 seconds \(an endless loop"):
        call(endless, (), 0.2)

    def stubborn():
        for _ in range(2):
            try:
                endless()
            except BaseException:
                pass
        endless()

    with pytest.raises(Stopped, match="no answer"):
        call(stubborn, (), 0.1)
    with pytest.raises(Stopped, match="no answer"):
        call(lambda: [time.sleep(0.05) for _ in range(10**6)], (), 0.05)


def test_the_users_own_interruption_passes():
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), time_limit(5.0):
        interrupted()
