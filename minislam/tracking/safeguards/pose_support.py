"""Poses that little of the flow supports: other starts, or the frame is lost.

In a wide gap between keyframes the interpolated pose may be far off; a good neighbour's is nearer.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import lengths, relative_transforms, reproject

DOUBTFUL_SUPPORT = 0.5  # of the median of all frames: with less, other starts are tried [-]
LOST_SUPPORT = 0.1  # the same: with less after all starts, the frame is lost [-]
# Residual that a pose explains: px at 320x240, plus this part of the flow, which first falls short.
EXPLAINED_PX, EXPLAINED_FRACTION = 3.0, 0.25
CHANCE = 0.25  # of the weight of a random flow is explained as well; .95 and more of a good one [-]
REPEATED = 0.001  # mean difference of an image from the one that it repeats, encoded again [-]


@dataclass(frozen=True)
class PoseFit:
    """A pose and how much of the flow fits it."""

    T_camera_world: Tensor  # (4, 4)
    support: float  # in [0, 1], robust weight of the flow over the weight of the cells


def retry_doubtful(
    fits: dict[int, PoseFit],  # of all frames, changed in place
    others: list[int],  # indices of the frames between keyframes, increasing
    fit_from: Callable[[int, Tensor], PoseFit],  # frame index and start (4, 4) -> fit
) -> list[int]:
    """Start doubtful frames again from the frame before, then from the frame after; keep the best.

    Frames that stay without support are taken out and returned.
    """
    typical = float(np.median([fits[index].support for index in others])) if others else 0.0
    for step in (-1, 1):
        for index in others[::-step]:
            if fits[index].support < DOUBTFUL_SUPPORT * typical and index + step in fits:
                other = fit_from(index, fits[index + step].T_camera_world)
                fits[index] = max(fits[index], other, key=lambda fit: fit.support)
    lost = [index for index in others if fits[index].support < LOST_SUPPORT * typical]
    for index in lost:
        del fits[index]
    return lost


def repeats(frame: Frame, before: Frame) -> bool:
    """Tell whether an image repeats the one before: a recorder froze. Noise differs by more."""
    return float((frame.image - before.image).abs().mean()) < REPEATED


def judged_by_pose(graph: KeyframeGraph, matches: FlowMatches) -> FlowMatches:
    """Return a learned flow (E = 1) from the newest keyframe, judged by the best pose for it.

    Its matched ratio is the fraction of its weight that the pose explains beyond chance, because
    the confidence of a network weighs cells and does not tell which are matched.
    """
    pose = graph.start_pose(matches, torch.ones_like(graph.grid.rays[:, 0]))
    ends = torch.stack([graph.keyframes.T_camera_world[-1], pose])
    motion = relative_transforms(ends, [0], [1]).float()
    disparities = graph.keyframes.disparities[-1:]
    predicted, _ = reproject(motion, disparities, graph.grid.rays, graph.grid.camera)
    flow = lengths(matches.targets - graph.grid.pixels.T)
    allowed = EXPLAINED_PX * graph.pixel_scale + EXPLAINED_FRACTION * flow
    weights = matches.confidences.mean(1)
    explained = weights * (lengths(matches.targets - predicted) < allowed)
    ratio = (explained.sum(1) / weights.sum(1) - CHANCE) / (1 - CHANCE)
    return replace(matches, matched_ratios=ratio.clamp_min(0))
