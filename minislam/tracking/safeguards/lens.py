"""Radial distortion that no calibration gives, estimated from the flow.

A wide lens shows the ray u of a pinhole, r = |u|, not at x = c + f u but at

    x + k1 d_1(x) + k2 d_2(x),    d_n(x) = r^(2 n) f u    (Brown's model).

With k1 and k2 known, cells and flow are straightened and Eq. (5) is that of a pinhole. By a further
k a straightened point x moves by -d_n(x) / (1 + 3 k1 r^2 + 5 k2 r^4), which is -D_n(x). While the
image turns little from one keyframe to the other, the flow from x to p~ is that of a pinhole at

    p~ + k1 (D_1(x) - D_1(p~)) + k2 (D_2(x) - D_2(p~)),

so what k1 and k2 lack is unknown in Eq. (5), as readouts are. Straightening and BA alternate.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from minislam.errors import MinislamError
from minislam.geometry import Camera
from minislam.tracking.bundle_problem import BundleProblem
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing
from minislam.tracking.safeguards import focal_length
from minislam.tracking.safeguards.robust import least_cost

MOST_KEYFRAMES = 40  # from the first on: they tell a lens, in a few seconds
WIDENINGS_AGAIN = [8.0, 4.0, 1.0]  # of the robust weight: a path that was bent lets go of its flow
ROUNDS = 16  # of straightening and adjusting, at most, from either first width
LAST_BEND = 0.001  # a round that bends a corner by no more is the last [-]
INVERSION_STEPS = 50  # of the fixed point that inverts the lens
LEAST_STRETCH = 0.3  # of a ray: a stronger lens cannot be inverted at the corners [-]
# tests/benchmarks/diary/focal_length.md, "A lens that nobody told of". [-]
WORTH_SAYING, WORTH_SAVING, WORTH_UNDOING = 0.04, 0.03, 0.1
# What moves a corner farther in or out, or sees 130 degrees and more, is no lens but a failed fit.
MOST_INWARDS, MOST_OUTWARDS, LEAST_FOCAL = 0.4, 0.1, 0.23  # [-], [-] and image widths

Radial = tuple[float, float]  # k1, k2


@dataclass(frozen=True)
class LensFit:
    """The lens that fits the flow best."""

    focal: float  # px, fx at the working size
    radial: Radial  # k1 and k2 [-], with that focal length
    bend: float  # how far a corner moves, over its distance from the centre [-]
    saved: float  # fraction of the residual cost that k1 and k2 save, beside any focal length [-]

    @property
    def is_bent(self) -> bool:
        """Tell whether the images are probably no pinhole's: they are bent, and it saves much."""
        is_large = WORTH_SAYING < abs(self.bend) and self.bend < MOST_OUTWARDS
        return is_large and self.saved > WORTH_SAVING

    @property
    def is_worth_undoing(self) -> bool:
        """Tell whether the images should be straightened: that saves much."""
        return self.is_bent and self.bend > -MOST_INWARDS and self.saved > WORTH_UNDOING


class BentLens(MinislamError):
    """An unknown lens bends straight lines, and the images must be straightened first."""

    seconds = 0.0  # that the run has taken until then

    def __init__(self, lens: LensFit) -> None:
        self.lens = lens
        k1, k2 = lens.radial
        super().__init__(
            f"the flow fits a lens that bends straight lines, the corners by {lens.bend:+.0%}: the "
            f"run begins anew on straightened images, k1 = {k1:.3f}, k2 = {k2:.3f}; a calibration "
            "is better, if there is one"
        )


def check_lens(graph: KeyframeGraph, is_unknown: bool) -> LensFit | None:
    """Return the lens that fits, or None; raise `BentLens` if an unknown one must be undone."""
    lens = fit_lens(graph)
    if is_unknown and lens is not None and lens.is_worth_undoing:
        if lens.focal > LEAST_FOCAL * graph.grid.camera.width:
            raise BentLens(lens)
    return lens


def fit_lens(graph: KeyframeGraph) -> LensFit | None:
    """Fit k1 and k2 to the edges of the first keyframes; None: too few. Nothing is changed."""
    keyframes = range(min(len(graph.keyframes), MOST_KEYFRAMES))
    is_enough = len(keyframes) >= focal_length.LEAST_KEYFRAMES
    among = focal_length.problem_among(graph, keyframes) if is_enough else None
    if among is None:
        return None
    problem, state = replace(among[0], free_focal=True), among[1]
    _, pinhole = adjust_narrowing(problem, state, focal_length.WIDENINGS, focal_length.ITERATIONS)
    radial = (0.0, 0.0)
    for widenings in (focal_length.WIDENINGS, WIDENINGS_AGAIN):
        for _ in range(ROUNDS):
            lens = straightened(problem, radial)
            found, _ = adjust_narrowing(lens, state, widenings, focal_length.ITERATIONS)
            state, widenings = replace(found, shifts=(0.0, 0.0)), [1.0]
            before, radial = radial, _without_fold(problem.camera, radial, found.shifts)
            if abs(bend_of(problem.camera, radial) - bend_of(problem.camera, before)) < LAST_BEND:
                break
    lens = replace(straightened(problem, radial), shift_columns=None)
    state, held = adjust_narrowing(lens, state, [1.0], focal_length.ITERATIONS)
    floor = least_cost(problem.weights)
    saved = (pinhole.cost_after - held.cost_after) / max(pinhole.cost_after, floor)
    zoom, bend = math.exp(state.log_focal), bend_of(problem.camera, radial)
    radial = radial[0] * zoom**2, radial[1] * zoom**4
    return LensFit(zoom * problem.camera.fx, radial, bend, saved)


def _without_fold(camera: Camera, radial: Radial, step: Radial) -> Radial:
    """Return radial + step, or less of the step where the lens would fold the image."""
    while True:
        further = radial[0] + step[0], radial[1] + step[1]
        if bend_of(camera, further) > LEAST_STRETCH - 1:
            return further
        step = step[0] / 2, step[1] / 2


def straightened(problem: BundleProblem, radial: Radial) -> BundleProblem:
    """Return the problem with rays and targets straightened; what k1 and k2 still lack is free.

    Where straightening spreads the image, errors of the flow spread with it and weigh less.
    """
    camera, dtype = problem.camera, problem.targets.dtype
    centre = problem.targets.new_tensor([[camera.cx], [camera.cy]])
    focal = problem.targets.new_tensor([[camera.fx], [camera.fy]])
    source = true_rays(problem.rays[:, :2].mT, radial)  # (2, N)
    target = true_rays((problem.targets - centre) / focal, radial)  # (E, 2, N)
    rays = torch.cat([source, torch.ones_like(source[:1])]).mT.to(dtype)
    columns = bends(camera, source, radial) - bends(camera, target, radial)
    positions = centre + focal * target
    weights = problem.weights * stretch(target, radial).square().to(dtype)
    targets, columns = positions.to(dtype), columns.to(dtype)
    return replace(problem, rays=rays, targets=targets, weights=weights, shift_columns=columns)


def true_rays(seen: Tensor, radial: Radial) -> Tensor:  # (..., 2, N) float64
    """Return the true rays of what the lens shows in the directions `seen` (..., 2, N)."""
    u = seen = seen.double()
    for _ in range(INVERSION_STEPS):
        u = seen / stretch(u, radial)
    return u


def stretch(u: Tensor, radial: Radial) -> Tensor:  # (..., 1, N)
    """Return how much farther from the centre the lens shows rays u (..., 2, N)."""
    squared = u.square().sum(-2, keepdim=True)
    return (1 + radial[0] * squared + radial[1] * squared.square()).clamp_min(LEAST_STRETCH)


def bends(camera: Camera, u: Tensor, radial: Radial) -> Tensor:  # (..., 2, 2, N) px per unit of k
    """Return D_1 and D_2 of straightened points, from their rays u (..., 2, N)."""
    squared = u.square().sum(-2, keepdim=True)
    slope = 1 + 3 * radial[0] * squared + 5 * radial[1] * squared.square()
    scaled = u * u.new_tensor([[camera.fx], [camera.fy]]) / slope.clamp_min(LEAST_STRETCH)
    return torch.stack([squared * scaled, squared.square() * scaled], -3)


def bend_of(camera: Camera, radial: Radial) -> float:
    """Return how far the lens moves a corner of the image, over its distance from the centre."""
    corner = torch.tensor([[camera.cx / camera.fx], [camera.cy / camera.fy]], device="cpu")
    return float(stretch(true_rays(corner, radial), radial)) - 1
