"""How much brighter a keyframe is than the map: automatic exposure and white balance.

A camera adapts to the light. Matched static cells give the factors a_k of each colour channel:

    log a_j - log a_i = median of log I_j(p~_ij) - log I_i(p_i)      over the cells of an edge.

All that stands still counts alike. Brightness asks for no texture, and what is textured may be a
shiny thing, which grows darker as the camera walks around it. All edges together are a linear
least-squares problem, in which each counts by the weight of its matches. A common factor is free:
the median is 1. Not in the paper; MonoGS optimises such factors.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.records import Frame, MapImage
from minislam.state.memory import release
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards.robust import weighted_median

BLUR = 2.0  # px: a match is not exact, and a median of noise is biased in the dark
DARKEST, BRIGHTEST = 0.04, 0.96  # beyond, a pixel may be black or saturated
KEPT = 20  # blurred images in the cache: most edges join neighbours
LEAST_CHANGE = 0.03  # log of a factor: if none is larger, one exposure is assumed
LEAST_WEIGHT = 0.015  # of the heaviest edge: with less, a few chance matches would decide [-]
STEADY = 1e-6  # weight of "as bright as the keyframe before", for keyframes without an edge
Shot = TypeVar("Shot", Frame, MapImage)


def keyframe_exposures(
    graph: KeyframeGraph,
    static_weights: Tensor,  # (K, N) in [0, 1], from beta alone: plain cells confirm no depth
) -> dict[int, Tensor]:
    """Return each keyframe's exposure (3,) by frame index, with median 1; {} if all are alike."""
    edges, keyframes, frames = graph.edges, graph.keyframes, graph.keyframes.frames
    standing = static_weights * keyframes.standing_weights
    cells = torch.stack([standing, keyframes.cell_weights], -1)
    # A row is a pair of keyframes, its weight, and how much brighter the second is (log, 3).
    neighbours = [(pair, STEADY, [0.0] * 3) for pair in pairwise(range(len(frames)))]
    linked = []

    @lru_cache(maxsize=KEPT)
    def blurred(keyframe: int) -> np.ndarray:  # (H, W, 3)
        release()
        return cv2.GaussianBlur(frames[keyframe].image.cpu().numpy(), (0, 0), BLUR)

    for edge, (source, target) in enumerate(edges.ends):
        targets, stride = edges.targets[edge], graph.grid.stride
        here = torch.from_numpy(blurred(source)[::stride, ::stride].reshape(-1, 3))
        u, v = targets.cpu().numpy().reshape(2, *graph.grid.shape)
        there = torch.from_numpy(cv2.remap(blurred(target), u, v, cv2.INTER_LINEAR).reshape(-1, 3))
        both = torch.cat([here, there], 1)
        visible = ((both > DARKEST) & (both < BRIGHTEST)).all(1)
        stands, weighs = (cells[source] * graph.grid.sample(cells[target], targets.T)).unbind(-1)
        ratio = (there.clamp_min(DARKEST) / here.clamp_min(DARKEST)).log()
        step = [weighted_median(channel, visible * stands.cpu()) for channel in ratio.T]
        weight = visible * (edges.confidences[edge][0] * weighs).cpu()
        linked.append(((source, target), float(weight.mean()), step))
    least = LEAST_WEIGHT * max((weight for _, weight, _ in linked), default=0.0)
    rows = [*neighbours, *(row for row in linked if row[1] > least)]
    pairs, pair_weights, steps = map(np.array, zip(*rows, strict=True))
    levels = _levels(len(frames), pairs, pair_weights, steps)
    if np.abs(levels).max() < LEAST_CHANGE:
        return {}
    exposures = torch.from_numpy(np.exp(levels)).float().to(graph.grid.rays.device)
    return {frame.frame_index: exposure for frame, exposure in zip(frames, exposures, strict=True)}


def _levels(
    count: int,  # K images
    pairs: np.ndarray,  # (E, 2) of them
    weights: np.ndarray,  # (E,)
    steps: np.ndarray,  # (E, 3) how much higher the second of a pair is
) -> np.ndarray:  # (K, 3) of median 0
    """Return the levels that fit the steps best, by the normal equations: E is up to 20 K."""
    source, target = pairs.T
    matrix, right = np.zeros((count, count)), np.zeros((count, 3))
    for here, there, sign in ((target, source, 1), (source, target, -1)):
        np.add.at(matrix, (here, here), weights)
        np.add.at(matrix, (here, there), -weights)
        np.add.at(right, here, sign * weights[:, None] * steps)
    levels = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return levels - np.median(levels, 0)


def with_exposure(frame: Shot, exposures: dict[int, Tensor]) -> Shot:
    """Return a frame with its exposure."""
    return replace(frame, exposure=exposure_at(frame.frame_index, exposures))


def exposure_at(frame_index: int, exposures: dict[int, Tensor]) -> Tensor | None:  # (3,)
    """Return the exposure of any frame, interpolated between the nearest known ones in time."""
    if not exposures:
        return None
    levels = torch.stack(list(exposures.values())).log()
    channels = levels.T.cpu().numpy()
    here = [np.interp(frame_index, list(exposures), channel) for channel in channels]
    return torch.tensor(here, device=levels.device).exp().to(levels)
