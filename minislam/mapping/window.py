"""The local window of keyframes, and which keyframe is optimised next (Sec. 3.4)."""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse

_PROTECTED = 2  # the newest keyframes of a window, which always stay, MonoGS


def overlap_coefficient(
    seen_a: Tensor,  # (N,) bool, Gaussians that keyframe a sees
    seen_b: Tensor,  # (N,) bool
) -> float:
    """Return |A and B| / min(|A|, |B|), or 0 if one of them sees nothing."""
    smaller = min(int(seen_a.sum()), int(seen_b.sum()))
    return int((seen_a & seen_b).sum()) / smaller if smaller else 0.0


def update_window(
    window: list[int],  # positions of keyframes, newest first
    new: int,  # position of the new keyframe
    seen: dict[int, Tensor],  # (N,) bool per position of `window` and of `new`
    T_camera_world: Tensor,  # (K, 4, 4) of all keyframes
    size: int,  # most keyframes in a window
    least_overlap: float,  # share in [0, 1]
) -> list[int]:
    """Return the window with the new keyframe first and at most one that lost sight of it less.

    The oldest keyframe that shares too little with the new one leaves; then, if the window is
    still too large, the one that is far from the new keyframe and close to others (DSO's rule).
    """
    window = [new, *window]
    strangers = [
        position
        for position in window[_PROTECTED:]
        if overlap_coefficient(seen[new], seen[position]) <= least_overlap
    ]
    if strangers:
        window.remove(strangers[-1])
    while len(window) > size:
        window.remove(_most_redundant(window, T_camera_world))
    return window


def _most_redundant(window: list[int], T_camera_world: Tensor) -> int:
    """Return the position whose score sqrt(d_new) * sum_j 1 / d_j is largest."""
    centres = se3_inverse(T_camera_world[window])[:, :3, 3]
    distances = torch.cdist(centres, centres)
    # Two keyframes at one place must not divide by zero; relative to the size of the window.
    inverse = 1 / (distances + 1e-6 * (distances.max() + 1e-12))
    candidates = inverse[_PROTECTED:, _PROTECTED:]
    crowding = candidates.sum(-1) - candidates.diagonal()
    score = distances[_PROTECTED:, 0].sqrt() * crowding
    return window[_PROTECTED + int(score.argmax())]


def sampling_probabilities(
    count: int,  # N keyframes
    window: list[int],  # positions of keyframes
    share: float,  # probability that the sample comes from the window
) -> Tensor:  # (N,) float64, sum 1
    """Return the probability of each keyframe: half of it for the window, half for the others.

    While the window holds more than its share of all keyframes, all are equally likely, which
    gives the window at least that share. It also covers N = |W|, where no other keyframe exists.
    """
    if len(window) > share * count:
        return torch.full((count,), 1 / count, dtype=torch.float64)
    others = (1 - share) / (count - len(window))
    probabilities = torch.full((count,), others, dtype=torch.float64)
    probabilities[window] = share / len(window)
    return probabilities
