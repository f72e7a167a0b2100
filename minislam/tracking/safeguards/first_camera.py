"""The start with an unknown focal length or readout: which minimum is taken, and its camera.

Hypotheses of the first depths end in several minima. With a wrong camera the right one need not be
the lowest. So the unknowns of the camera, its focal length and the readout, are free before costs
are compared (tests/benchmarks/diary/focal_length.md and rolling_shutter.md).

Under a long lens, or where the camera hardly walks, a scene and its mirror image in depth have
nearly the same flow. The paper starts from the depth prior, which tells them apart.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from minislam.tracking.bundle_adjustment import BundleReport
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.pose_from_flow import ROBUST_WIDENING
from minislam.tracking.safeguards.focal_length import LEAST_KEYFRAMES, fit_focal_length
from minislam.workers import Workers

ITERATIONS = 8  # Gauss-Newton steps per width before hypotheses are compared
WIDENINGS = [*ROBUST_WIDENING, 0.5, 0.25]  # of the robust weight, times the final width [-]
SAME_COST = 1e-3  # hypotheses that differ less have met in one minimum [-]
OTHER_FOCALS = (math.log(0.5), math.log(2.0))  # starts, too: each reaches a third either way
FOCAL_WORTH_SAVING = 0.05  # of the cost: for each doubling of the guess, and to free it [-]
FARTHEST = math.log(4)  # from the guessed focal length; farther off, the start has failed
RELIEF_WORTH_SAVING = 0.1  # of the cost, per unit of correlation with the usual disparities [-]
READOUT_WORTH_SAVING = 0.05  # more than later: in a short pan it looks like a focal length [-]

Found = tuple[BundleState, BundleReport]


def minima(
    problem: BundleProblem,
    states: list[BundleState],
    workers: Workers | None = None,  # adjust side by side
) -> list[Found]:
    """Adjust every hypothesis on the same measurements; return where they end, of equals the first.

    Each is adjusted from the widest robust weight and from the second widest: under a wide one a
    bad guess leaves its wrong minimum, but a large dynamic object may outvote the room.
    """
    starts = [WIDENINGS, WIDENINGS[1:]] if problem.robust else [[1.0]]
    calls = [(problem, *pair, ITERATIONS) for pair in itertools.product(states, starts)]
    return _each_once((workers or Workers()).map(adjust_narrowing, calls))


def _each_once(found: list[Found]) -> list[Found]:
    """Return the first of those that have met in one minimum."""
    kept: list[Found] = []
    for one in found:
        if all(abs(cost_of(one) - cost_of(other)) > SAME_COST * cost_of(one) for other in kept):
            kept.append(one)
    return kept


def cost_of(found: Found) -> float:  # px^2
    """Return the cost at which an adjustment ended."""
    return found[1].cost_after


def most_plausible(grid: Grid, known_disparities: Tensor, found: list[Found]) -> Found:
    """Return the result of lowest cost; what is usual decides between nearly equal ones.

    Usual are the guessed focal length, and disparities that grow with the prior's, or else with v.
    """
    known = known_disparities > 0  # (K, N)
    usual, cells = grid.pixels[:, 1].expand_as(known), torch.ones_like(known)
    if known.any():
        usual, cells = known_disparities.log(), known

    def implausible_cost(result: Found) -> float:
        state, report = result
        if abs(state.log_focal) > FARTHEST:
            return math.inf
        agrees = torch.corrcoef(torch.stack([usual[cells], state.disparities.log()[cells]]))[0, 1]
        doublings = abs(state.log_focal) / math.log(2)
        unusual = FOCAL_WORTH_SAVING * doublings - RELIEF_WORTH_SAVING * float(agrees.nan_to_num())
        return report.cost_after * (1 + unusual)

    return min(found, key=implausible_cost)


def lowest_minimum(
    graph: KeyframeGraph,
    start: Callable[[float], list[BundleState]],  # log_focal -> hypotheses
    workers: Workers | None = None,
) -> Found:
    """Return the geometry of the warm-up that is most plausible, adjusted with its camera.

    A readout that the flow measures is set in the graph, and so is whether the focal length is free
    from now on. With few keyframes both stay as guessed.
    """
    search = _Search(graph, workers or Workers())
    found = at_guess = minima(search.problem, start(0.0), search.workers)
    if search.seeks_focal:
        others = (minima(search.problem, start(log), search.workers) for log in OTHER_FOCALS)
        found = search.adjusted(search.free, [*found, *itertools.chain(*others)])
    chosen = search.with_readout(found) or search.best(found)
    return search.with_focal(chosen, at_guess) if search.seeks_focal else chosen


class _Search:
    """The search for the unknowns of the camera among the minima of a warm-up."""

    def __init__(self, graph: KeyframeGraph, workers: Workers) -> None:
        self.graph, self.workers = graph, workers
        self.tells_camera = len(graph.keyframes) >= LEAST_KEYFRAMES
        self.seeks_focal = graph.seeks_focal and self.tells_camera
        self.positions = list(range(len(graph.edges)))
        self.problem = bundle_problem(graph, self.positions)

    @property
    def free(self) -> BundleProblem:
        """The problem with an unknown focal length, if it is to be found."""
        return replace(self.problem, free_focal=self.seeks_focal)

    def adjusted(self, problem: BundleProblem, found: list[Found]) -> list[Found]:
        """Adjust some results again; return the first of those that meet in one minimum."""
        calls = [(problem, state, WIDENINGS[1:], ITERATIONS) for state, _ in found]
        return _each_once(self.workers.map(adjust_narrowing, calls))

    def best(self, found: list[Found]) -> Found:
        """Return the most plausible result; under a given focal length, that of lowest cost."""
        if not self.graph.seeks_focal:
            return min(found, key=cost_of)
        return most_plausible(self.graph.grid, self.graph.keyframes.prior_disparities, found)

    def with_readout(self, found: list[Found]) -> Found | None:
        """Let the graph take the best readout if it saves enough; return the geometry, or None."""
        shutter = self.graph.shutter
        columns = shutter.edge_columns(self.positions) if self.tells_camera else None
        if columns is None or not columns.any():
            return None
        rolled = self.best(self.adjusted(replace(self.free, shift_columns=columns), found))
        saves = cost_of(rolled) < (1 - READOUT_WORTH_SAVING) * min(map(cost_of, found))
        if not (saves and shutter.is_possible(rolled[0].shifts)):
            return None
        shutter.take(rolled[0].shifts)
        self.problem = bundle_problem(self.graph, self.positions)  # of the corrected flow
        return adjust_narrowing(self.free, rolled[0], WIDENINGS[2:], ITERATIONS)

    def with_focal(self, chosen: Found, at_guess: list[Found]) -> Found:
        """Return the geometry with its own focal length, which is free from now on.

        If that is not observable and saves little, return the best one with the guessed one.
        """
        own = replace(chosen[0], log_focal=0.0), chosen[1]  # the same geometry under the guess
        held = self.adjusted(self.problem, [own])
        fit, fitted = fit_focal_length(self.problem, held[0][0], self.workers, chosen[0])
        if fit.factor is not None:
            chosen = adjust_narrowing(self.free, fitted, WIDENINGS[2:], ITERATIONS)
        else:
            held = _each_once([*held, *self.adjusted(self.problem, at_guess)])
            saving = 1 - cost_of(chosen) / min(map(cost_of, held))
            if abs(chosen[0].log_focal) > FARTHEST or saving <= FOCAL_WORTH_SAVING:
                return self.best(held)
        self.graph.focal_is_free = True
        return chosen
