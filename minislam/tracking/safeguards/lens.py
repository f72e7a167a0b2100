"""A lens that bends straight lines although nobody said so: told from the flow.

A wide lens shows the ray u of a pinhole, |u|^2 = u_x^2 + u_y^2, not at x = c + f u, but at

    x + k1 d_1(x) + k2 d_2(x),    d_n(x) = |u|^(2 n) f u    (Brown's model).

No pinhole fits its flow, so focal length and poses bend to fit it half. While the image turns
little from one keyframe to the other, flow from cell x to p~ becomes that of a pinhole by

    p~ + k1 (d_1(x) - d_1(p~)) + k2 (d_2(x) - d_2(p~)),

to first order in k. So k1 and k2 are unknowns of Eq. (5) as the readouts of a rolling shutter are.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing
from minislam.tracking.safeguards.focal_length import (
    ITERATIONS,
    LEAST_KEYFRAMES,
    WIDENINGS,
    problem_among,
)
from minislam.tracking.safeguards.robust import MIN_RESIDUAL

MOST_KEYFRAMES = 40  # from the first on: they tell a lens, in a few seconds
# RESULTS.md, "A lens that nobody told of". [-]
WORTH_SAYING, WORTH_SAVING = 0.04, 0.03


@dataclass(frozen=True)
class LensFit:
    """The radial distortion that the flow fits best."""

    bend: float  # how far a corner moves, over its distance from the centre [-]
    saved: float  # fraction of the residual cost that it saves, beside any focal length [-]

    @property
    def is_bent(self) -> bool:
        """Tell whether the images are probably no pinhole's: both thresholds are exceeded."""
        return abs(self.bend) > WORTH_SAYING and self.saved > WORTH_SAVING


def check_lens(graph: KeyframeGraph) -> LensFit | None:
    """Fit k1 and k2 to the links of the first keyframes; None: too few. Nothing is changed."""
    keyframes = range(min(len(graph.keyframes), MOST_KEYFRAMES))
    among = problem_among(graph, keyframes) if len(keyframes) >= LEAST_KEYFRAMES else None
    if among is None:
        return None
    problem, state = replace(among[0], free_focal=True), among[1]
    columns = lens_columns(problem.camera, problem.rays, problem.targets)
    _, pinhole = adjust_narrowing(problem, state, WIDENINGS, ITERATIONS)
    bent = replace(problem, shutter=columns)
    found, lens = adjust_narrowing(bent, state, WIDENINGS, ITERATIONS)
    floor = MIN_RESIDUAL**2 * float(problem.weights.mean(1).sum())
    saved = (pinhole.cost_after - lens.cost_after) / max(pinhole.cost_after, floor)
    camera, (k1, k2) = problem.camera, found.readout
    corner = math.hypot(camera.cx / camera.fx, camera.cy / camera.fy)
    return LensFit(k1 * corner**2 + k2 * corner**4, saved)


def lens_columns(
    camera: Camera,
    rays: Tensor,  # (N, 3) of the source's cells
    targets: Tensor,  # (E, 2, N) px, where the flow leads
) -> Tensor:  # (E, 2, 2, N) px per unit of k1 and of k2
    """Return d_n(x) - d_n(p~) for n = 1 and 2."""
    centre = targets.new_tensor([[camera.cx], [camera.cy]])
    focal = targets.new_tensor([[camera.fx], [camera.fy]])

    def bent(u: Tensor) -> Tensor:  # (..., 2, N) -> (..., 2, 2, N)
        squared = u.square().sum(-2, keepdim=True)
        return torch.stack([squared * focal * u, squared**2 * focal * u], -3)

    return bent(rays[:, :2].T) - bent((targets - centre) / focal)
