"""Functions for tests/test_workers.py that a helper can import."""

import os
import time
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Pair:
    first: Tensor
    second: Tensor | None
    sizes: tuple[int, int]


def swapped(pair: Pair, factor: float) -> dict[str, Pair]:
    second = pair.first if pair.second is None else pair.second
    return {"swapped": Pair(second * factor, pair.first, pair.sizes[::-1])}


def process_of(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def dies_in_a_helper(parent: int, number: int) -> int:
    if os.getpid() != parent:
        os.kill(os.getpid(), 9)
    return number


def fails(number: int) -> int:
    raise ZeroDivisionError(f"number {number}")


def prints(number: int) -> int:
    os.write(1, b"noise")
    return number
