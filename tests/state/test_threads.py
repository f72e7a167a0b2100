"""Calls that threads compute side by side: in order, a few at a time, and errors are raised."""

import threading
import time
from collections.abc import Iterator

import pytest
import torch

from minislam.state.threads import THREADS, side_by_side


def test_results_come_in_the_order_of_the_calls():
    def slow_first(number: int) -> int:
        time.sleep(0.02 * (number == 0))
        return number

    assert list(side_by_side(slow_first, ((k,) for k in range(7)))) == list(range(7))
    assert list(side_by_side(slow_first, ())) == []


def test_two_calls_are_computed_at_once():
    both = threading.Barrier(THREADS, timeout=10)
    assert len(list(side_by_side(lambda k: both.wait(), [(0,), (1,)]))) == THREADS


def test_calls_are_asked_for_a_few_at_a_time():
    asked = []

    def calls() -> Iterator[tuple[int]]:
        for number in range(20):
            asked.append(number)
            yield (number,)

    results = side_by_side(lambda number: number, calls())
    assert next(results) == 0 and len(asked) == THREADS + 1


def test_an_error_is_raised_where_its_result_is_asked_for():
    results = side_by_side(lambda number: 1 / number, [(1,), (0,)])
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_a_thread_of_torch_does_not_start_more_of_its_own():
    torch.set_num_threads(1)
    assert list(side_by_side(lambda k: torch.get_num_threads(), [(0,), (1,)])) == [1, 1]
