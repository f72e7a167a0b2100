"""The focal length and the readout that fit the flow.

A focal length is estimated where it is unknown and checked where it is given. It is one more
unknown of the bundle adjustment (focal_column.py), which converges from 0.75 to 1.3 times the
truth. A camera that does not turn fits its flow with any. So an estimate counts only if the cost of
the adjusted keyframes rises on both sides of it, less if it saves much.

If the lens zooms while it films, half of the keyframes fit another focal length than all of them.
"""

import math
from dataclasses import dataclass, replace

import torch

from minislam.tracking.bundle_adjustment import bundle_adjust
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.safeguards.parts import Start, of_cells, of_rows
from minislam.tracking.safeguards.robust import least_cost
from minislam.workers import Workers

STEP = math.log(1.05)  # to either side, where the cost must have risen
ITERATIONS = 10  # Gauss-Newton steps of each adjustment
WIDENINGS = [4.0, 1.0]  # of the robust weight: a focal length far off has large residuals [-]
MOST_KEYFRAMES = 100  # that a check adjusts, dozens of times: the first, of a second half the last
EVERY = 2  # cells of a check along each side: it adjusts so often, and few unknowns ask for few
MAX_TRIES = 8  # adjustments, each from the better side of the one before
LARGEST = math.log(2.0)  # either way; what is further off is no focal length but a failed run
MIN_RISE = 0.012  # smallest mean rise of the cost; where the estimate was right, .013 and more [-]
MIN_RISE_OF_BETTER = 0.003  # where it saves much; where right, .006 and more, wrong .0014 [-]
# A warning needs both: a right focal length has looked 5.4 % off, but the other saved 1.3 %. [-]
WORTH_SAYING, WORTH_SAVING = 0.05, 0.02
READOUT_WORTH_SAVING = 0.02  # of the cost: rolling shutters 3 to 37 %, others at most 1.2 %
LEAST_KEYFRAMES = 4  # fewer do not measure it (diary/focal_length.md)
LEAST_HALF = 6  # keyframes of half a clip that is checked alone
HALF_WORTH_SAVING = 0.1  # zooms of 1.5 saved 14 to 53 %, the right focal length at most 1 % [-]


@dataclass(frozen=True)
class FocalLengthFit:
    """The focal length that fits the flow best."""

    present: float  # px, fx at the working size
    factor: float | None  # best focal length / present one; None: it is not observable
    saved: float  # fraction of the residual cost that the best one saves [-]
    half: tuple[int, int] | None = None  # first and last frame, if it is of one half alone

    @property
    def is_doubtful(self) -> bool:
        """Tell whether the present focal length is probably wrong: both thresholds are exceeded."""
        is_other = self.factor is not None and abs(math.log(self.factor)) > WORTH_SAYING
        return is_other and self.saved > (HALF_WORTH_SAVING if self.half else WORTH_SAVING)


def check_focal_length(
    graph: KeyframeGraph, workers: Workers | None = None
) -> FocalLengthFit | None:
    """Fit a given focal length to the first MOST_KEYFRAMES, or to a half if another one fits there.

    Nothing is changed. Of a longer half, its outer MOST_KEYFRAMES count. A focal length that was
    found, not given, is checked in the halves alone.
    """
    every = range(len(graph.keyframes))
    whole = None if graph.seeks_focal else _fit_among(graph, every[:MOST_KEYFRAMES], workers)
    if (whole and whole.is_doubtful) or len(every) < 2 * LEAST_HALF:
        return whole
    middle = len(every) // 2
    for half in every[:middle][:MOST_KEYFRAMES], every[middle:][-MOST_KEYFRAMES:]:
        if whole and half == every[:MOST_KEYFRAMES]:
            continue  # fitted already
        first, last = (graph.keyframes.frames[end].frame_index for end in (half[0], half[-1]))
        fit = replace(_fit_among(graph, half, workers), half=(first, last))
        if fit.is_doubtful:
            return fit
    return whole


def _fit_among(graph: KeyframeGraph, keyframes: range, workers: Workers | None) -> FocalLengthFit:
    """Return the focal length that the edges among some keyframes fit."""
    among = problem_among(graph, keyframes)
    if among is None:
        return FocalLengthFit(graph.grid.camera.fx, None, 0.0)
    return fit_focal_length(*among, workers)[0]


def problem_among(graph: KeyframeGraph, keyframes: range, readout: bool = False) -> Start | None:
    """Return problem and state of the edges among some keyframes, at few cells; None: no edge."""
    edges = enumerate(graph.edges.ends)
    positions = [p for p, edge in edges if min(edge) in keyframes and max(edge) in keyframes]
    if not positions:
        return None
    columns = graph.shutter.edge_columns(positions) if readout else None
    problem = replace(bundle_problem(graph, positions), shift_columns=columns)
    rows = torch.tensor(keyframes, device=problem.rays.device)
    cells = torch.arange(len(problem.rays), device=rows.device).view(graph.grid.shape)
    among = of_cells(*of_rows(problem, graph.state, rows), cells[::EVERY, ::EVERY].flatten())
    among[0].free_poses[0] = False  # the first of them is their world
    return among


def seek_focal_length(graph: KeyframeGraph, workers: Workers | None = None) -> None:
    """Set an unknown focal length to the best fit if it is observable; from then on it is free."""
    if not graph.seeks_focal or len(graph.keyframes) < LEAST_KEYFRAMES:
        return
    problem = bundle_problem(graph, range(len(graph.edges)))
    fit, state = fit_focal_length(problem, graph.state, workers)
    if fit.factor is not None:
        graph.keyframes.set_geometry(state.T_camera_world, state.disparities)
        graph.grid.zoom(state.log_focal)
        graph.focal_is_free = True


def fit_focal_length(
    problem: BundleProblem,
    state: BundleState,
    workers: Workers | None = None,  # adjust side by side
    start: BundleState | None = None,  # of the search; None: from the state
) -> tuple[FocalLengthFit, BundleState]:
    """Return the fit of lowest adjusted cost and its state; if unobservable, `state` itself."""
    workers, free = workers or Workers(), replace(problem, free_focal=True)
    starts = [(*pair, WIDENINGS, ITERATIONS) for pair in ((problem, state), (free, start or state))]
    (_, present), (found, best) = workers.map(adjust_narrowing, starts)
    for _ in range(MAX_TRIES):
        ends = [replace(found, log_focal=found.log_focal + step) for step in (-STEP, STEP)]
        beside = workers.map(adjust_narrowing, [(problem, end, [1.0], ITERATIONS) for end in ends])
        rises = [report.cost_after - best.cost_after for _, report in beside]
        if min(rises) > 0:
            break
        # Not yet in the valley: go on from there. A wide weight might lead back.
        better = beside[rises.index(min(rises))][0]
        found, best = adjust_narrowing(free, better, [1.0], ITERATIONS)
    lowest = best.cost_after
    floor = least_cost(problem.weights)
    saved = (present.cost_after - lowest) / max(present.cost_after, floor)
    least_rise = MIN_RISE if saved < WORTH_SAVING else MIN_RISE_OF_BETTER
    rises_enough = sum(rises) / 2 >= least_rise * max(lowest, floor)
    fx, change = problem.camera.fx * math.exp(state.log_focal), found.log_focal - state.log_focal
    if min(rises) <= 0 or not rises_enough or abs(change) > LARGEST:
        return FocalLengthFit(fx, None, 0.0), state
    return FocalLengthFit(fx, math.exp(change), saved), found


def seek_readouts(graph: KeyframeGraph) -> None:
    """Set the readout that fits best, unless it saves as little as noise and movers would."""
    shutter, count = graph.shutter, len(graph.keyframes)
    if not shutter.is_on or shutter.is_found or count < LEAST_KEYFRAMES:
        return
    among = problem_among(graph, range(min(MOST_KEYFRAMES, count)), readout=True)
    if among is None:
        return
    problem, start = replace(among[0], free_focal=graph.focal_is_free), among[1]
    _, held = bundle_adjust(replace(problem, shift_columns=None), start, ITERATIONS)
    state, free = bundle_adjust(problem, start, ITERATIONS)
    floor = least_cost(problem.weights)
    saved = held.cost_after - free.cost_after
    is_worth_it = saved > READOUT_WORTH_SAVING * max(held.cost_after, floor)
    if is_worth_it and shutter.is_possible(state.shifts):
        shutter.take(state.shifts)
