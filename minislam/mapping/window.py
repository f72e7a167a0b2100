"""The local window of keyframes, and which image each iteration renders (Sec. 3.4)."""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse

LEAST_OVERLAP = 0.4  # overlap coefficient below which a keyframe leaves the window, official
PROTECTED = 2  # the newest keyframes of a window, which always stay, MonoGS


def overlap_coefficient(seen_a: Tensor, seen_b: Tensor) -> float:  # both (N,) bool, Gaussians
    """Return |A and B| / min(|A|, |B|) of what two keyframes see, or 0 if one sees nothing."""
    smaller = min(int(seen_a.sum()), int(seen_b.sum()))
    return int((seen_a & seen_b).sum()) / smaller if smaller else 0.0


def update_window(
    window: list[int],  # positions of keyframes, newest first
    new: int,  # position of the new keyframe
    seen: dict[int, Tensor],  # (N,) bool per position of `window` and of `new`
    T_camera_world: Tensor,  # (K, 4, 4) of all keyframes
    size: int,  # most keyframes in a window
) -> list[int]:
    """Prepend the new keyframe; drop the oldest that hardly overlaps it, and what is too many."""
    window = [new, *window]
    overlaps = {k: overlap_coefficient(seen[new], seen[k]) for k in window[PROTECTED:]}
    leaving = [k for k, overlap in overlaps.items() if overlap <= LEAST_OVERLAP]
    if leaving:
        window.remove(leaving[-1])  # the oldest
    while len(window) > size:  # the keyframe far from the new one and close to others (DSO's rule)
        window.remove(_most_redundant(window, T_camera_world))
    return window


def _most_redundant(window: list[int], T_camera_world: Tensor) -> int:
    """Return the position whose score sqrt(d_new) * sum_j 1 / d_j is largest."""
    centres = se3_inverse(T_camera_world[window])[:, :3, 3]
    distances = torch.cdist(centres, centres)
    # The addend keeps two keyframes at one place from a division by zero, at any world scale.
    inverse = 1 / (distances + 1e-6 * (distances.max() + 1e-12))
    candidates = inverse[PROTECTED:, PROTECTED:]
    crowding = candidates.sum(-1) - candidates.diagonal()
    score = distances[PROTECTED:, 0].sqrt() * crowding
    return window[PROTECTED + int(score.argmax())]


def sampling_probabilities(
    count: int,  # N keyframes
    window: list[int],  # positions of keyframes
    window_probability: float,  # that the sample comes from the window
) -> Tensor:  # (N,) float64, sum 1
    """Return the probability of each keyframe: in the paper, 1/2 for the window in total."""
    if len(window) >= window_probability * count:  # it is drawn as often if all are equally likely
        return torch.full((count,), 1 / count, dtype=torch.float64, device="cpu")
    others = (1 - window_probability) / (count - len(window))
    probabilities = torch.full((count,), others, dtype=torch.float64, device="cpu")
    probabilities[window] = window_probability / len(window)
    return probabilities


def in_turn(iterations: range, count: int, seed: int) -> list[int]:
    """Return the image of each iteration: all `count` in turn, each round in another order."""
    orders = {}  # Drawn one by one, some images would be rendered half as often as others.
    for turn in {iteration // count for iteration in iterations}:
        generator = torch.Generator().manual_seed(seed + turn)
        orders[turn] = torch.randperm(count, generator=generator).tolist()
    return [orders[iteration // count][iteration % count] for iteration in iterations]
