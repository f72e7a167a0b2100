"""Semi-global aggregation: against a slow twin, and what it is for."""

import numpy as np
import pytest

from minislam.stereo.aggregation import (
    EDGE_SCALE,
    JUMP_COST,
    SMALLEST_JUMP_COST,
    STEP_COST,
    aggregate,
    refined_minimum,
)


def twin(cost: np.ndarray, gray: np.ndarray) -> np.ndarray:
    """Return the sum of L over eight directions by plain loops, pixel by pixel."""
    planes, height, width = cost.shape
    total = np.zeros_like(cost, dtype=float)
    for down, right in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        paths = np.zeros_like(total)
        rows = range(height) if down >= 0 else range(height - 1, -1, -1)
        columns = range(width) if right >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                b, a = y - down, x - right
                paths[:, y, x] = cost[:, y, x]
                if not (0 <= b < height and 0 <= a < width):
                    continue
                edge = 1 + abs(float(gray[y, x]) - float(gray[b, a])) / EDGE_SCALE
                jump = max(JUMP_COST / edge, SMALLEST_JUMP_COST)
                before = paths[:, b, a]
                for d in range(planes):
                    ways = [before[d], before.min() + jump]
                    ways += [before[k] + STEP_COST for k in (d - 1, d + 1) if 0 <= k < planes]
                    paths[d, y, x] += min(ways) - before.min()
        total += paths
    return total


def random_volume(seed: int) -> tuple[np.ndarray, np.ndarray]:
    source = np.random.default_rng(seed)
    cost, gray = source.random((7, 5, 6)), source.random((5, 6))
    return cost.astype(np.float32), gray.astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_plain_loops(seed: int):
    cost, gray = random_volume(seed)
    before = cost.copy()
    np.testing.assert_allclose(aggregate(cost, gray), twin(cost, gray), atol=1e-5)
    assert np.array_equal(cost, before)


def test_a_pixel_without_texture_takes_the_depth_of_its_surroundings():
    cost = np.full((6, 9, 9), 0.8, np.float32)
    cost[2] = 0.1
    cost[:, 3:6, 3:6] = 0.5  # nothing is known there
    best, _ = refined_minimum(aggregate(cost, np.full((9, 9), 0.5, np.float32)))
    assert (best == 2).all()


def test_the_fraction_is_the_minimum_of_the_parabola():
    planes = np.arange(8)
    total = ((planes - 3.3) ** 2)[:, None, None] + np.zeros((2, 2))
    best, fraction = refined_minimum(total)
    assert (best == 3).all()
    np.testing.assert_allclose(fraction, 0.3, atol=1e-6)


def test_at_the_ends_there_is_no_fraction():
    best, fraction = refined_minimum(np.stack([np.arange(5.0), np.arange(5.0)[::-1]], 1)[:, None])
    assert best.tolist() == [[0, 4]] and fraction.tolist() == [[0, 0]]
