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
    cost: np.ndarray,  # (h, w, D) float32
    gray: np.ndarray,  # (h, w) float32 in [0, 1]
) -> np.ndarray:  # (h, w, D) float32
    """Return the sum of L over eight directions."""
    total = np.zeros_like(cost)
    for flip in (slice(None), slice(None, None, -1)):
        for shift in (-1, 0, 1):
            total[flip] += _paths_down(cost[flip], gray[flip], shift)
        across = cost[:, flip].transpose(1, 0, 2)
        total[:, flip] += _paths_down(across, gray[:, flip].T, 0).transpose(1, 0, 2)
    return total


def _paths_down(cost: np.ndarray, gray: np.ndarray, shift: int) -> np.ndarray:
    """Return L along paths that come from the row above, `shift` columns to the left."""
    paths = np.empty(cost.shape, np.float32)
    paths[0] = cost[0]
    for row in range(1, len(cost)):
        before, shade = paths[row - 1], gray[row - 1]
        if shift:
            before, shade = np.roll(before, shift, 0), np.roll(shade, shift)
        edge = 1 + np.abs(gray[row] - shade) / EDGE_SCALE
        jump = np.maximum(JUMP_COST / edge, SMALLEST_JUMP_COST)
        lowest = before.min(-1, keepdims=True)
        best = np.minimum(before, lowest + jump[:, None])
        np.minimum(best[:, 1:], before[:, :-1] + STEP_COST, out=best[:, 1:])
        np.minimum(best[:, :-1], before[:, 1:] + STEP_COST, out=best[:, :-1])
        paths[row] = cost[row] + best - lowest
        if shift:  # the path that would come from outside the image starts here
            paths[row, 0 if shift > 0 else -1] = cost[row, 0 if shift > 0 else -1]
    return paths


def refined_minimum(total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return per pixel the plane of least cost, (h, w) int, and how far beyond it the minimum is.

    That is in [-0.5, 0.5] planes (h, w): the minimum of the parabola through three planes.
    """
    best = total.argmin(-1)
    inner = np.clip(best, 1, total.shape[-1] - 2)[..., None]
    left, middle, right = (
        np.take_along_axis(total, inner + offset, -1)[..., 0] for offset in (-1, 0, 1)
    )
    curvature = left - 2 * middle + right
    fraction = 0.5 * (left - right) / np.maximum(curvature, 1e-6)
    fraction = np.where(best == inner[..., 0], np.clip(fraction, -0.5, 0.5), 0)
    return best, fraction
