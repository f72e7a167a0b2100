"""Semi-global aggregation (Hirschmueller 2008): the depths of neighbouring pixels fit together.

The cost of one pixel alone has many minima where texture is weak or repeats. A path through the
image adds, at each pixel p and plane d, what the best path before it has cost:

    L(p, d) = C(p, d) + min(L(p', d), L(p', d +- 1) + step, min_k L(p', k) + jump) - min_k L(p', k).

A jump is cheaper at an image edge. Each pixel takes the plane of the least sum over 8 directions.
"""

import numpy as np

STEP_COST = 0.03  # of one plane between neighbours [-]
JUMP_COST = 0.25  # of more than one plane, in a flat image [-]
SMALLEST_JUMP_COST = 0.06  # at an image edge [-]
EDGE_SCALE = 0.05  # grey values: a difference that halves the cost of a jump


def aggregate(
    cost: np.ndarray,  # (D, h, w) float32
    gray: np.ndarray,  # (h, w) float32 in [0, 1]
) -> np.ndarray:  # (D, h, w) float32
    """Return the sum of L over eight directions."""
    # Row by row, and column by column: what a step along a path reads lies in one place.
    rows, columns = (np.ascontiguousarray(cost.transpose(axes)) for axes in ((1, 0, 2), (2, 0, 1)))
    total, across = np.zeros_like(rows), np.zeros_like(columns)
    for flip in (slice(None), slice(None, None, -1)):
        for shift in (-1, 0, 1):
            _add_paths_down(total[flip], rows[flip], gray[flip], shift)
        _add_paths_down(across[flip], columns[flip], gray.T[flip], 0)
    return np.ascontiguousarray(total.transpose(1, 0, 2) + across.transpose(1, 2, 0))


def _add_paths_down(total: np.ndarray, cost: np.ndarray, gray: np.ndarray, shift: int) -> None:
    """Add L along paths from the row above, `shift` columns to the left; at a border they start."""
    width = gray.shape[1]
    to, come_from = (slice(max(s, 0), width + min(s, 0)) for s in (shift, -shift))
    paths = cost[0].copy()
    total[0] += paths
    for row in range(1, len(gray)):
        before, shade = paths[:, come_from], gray[row - 1, come_from]
        edge = 1 + np.abs(gray[row, to] - shade) / EDGE_SCALE
        jump = np.maximum(JUMP_COST / edge, SMALLEST_JUMP_COST)
        lowest, stepped = before.min(0), before + STEP_COST
        best = np.minimum(before, lowest + jump)
        np.minimum(best[1:], stepped[:-1], out=best[1:])
        np.minimum(best[:-1], stepped[1:], out=best[:-1])
        paths = cost[row].copy()
        paths[:, to] += best - lowest
        total[row] += paths


def refined_minimum(total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return per pixel the plane of least cost, (h, w) int, and the sub-plane offset (h, w).

    The offset, in [-0.5, 0.5] planes, is the minimum of the parabola through three planes.
    """
    best = total.argmin(0)
    inner = np.clip(best, 1, len(total) - 2)
    left, middle, right = (
        np.take_along_axis(total, inner[None] + offset, 0)[0] for offset in (-1, 0, 1)
    )
    curvature = left - 2 * middle + right
    fraction = 0.5 * (left - right) / np.maximum(curvature, 1e-6)
    fraction = np.where(best == inner, np.clip(fraction, -0.5, 0.5), 0)
    return best, fraction
