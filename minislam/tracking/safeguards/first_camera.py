"""The start of a camera of which not everything is known: the minimum that its flow tells.

Hypotheses of the first depths end in several minima. With a wrong camera the right one need not be
the lowest: under a focal length that is 6 % too long, depth that is inside out fits better, and a
far hill that takes the rolling shutter for parallax can turn the rocks before it into outliers. So
what is unknown of the camera is free before costs are compared: its focal length, and the readout.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from minislam.tracking.bundle_adjustment import BundleProblem, BundleState
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import adjust_narrowing, bundle_problem
from minislam.tracking.pose_from_flow import ROBUST_WIDENING
from minislam.tracking.safeguards.first_depth import (
    FARTHEST,
    FOCAL_WORTH_SAVING,
    Found,
    cost_of,
    most_plausible,
)
from minislam.tracking.safeguards.focal_length import READOUT_WORTH_SAVING, fit_focal_length
from minislam.workers import Workers

ITERATIONS = 8  # Gauss-Newton steps per width before hypotheses are compared
WIDENINGS = [*ROBUST_WIDENING, 0.5, 0.25]  # of the robust weight, times the final width [-]
SAME_COST = 1e-3  # hypotheses that differ less have met in one minimum [-]
# Starts of an unknown focal length beside its guess: the search reaches 0.7 to 1.4 times the truth.
OTHER_FOCALS = (math.log(0.5), math.log(2.0))


def minima(
    problem: BundleProblem,
    states: list[BundleState],
    workers: Workers | None = None,  # adjust side by side
) -> list[Found]:
    """Adjust every hypothesis on the same measurements and return where they end, each place once.

    A wide robust weight lets a bad guess leave its wrong minimum, but under the widest one a large
    dynamic object may outvote the room. So every hypothesis starts from the two widest. Costs are
    compared under a narrow one, which a compromise between room and dynamic object does not fit.
    """
    starts = [WIDENINGS, WIDENINGS[1:]] if problem.robust else [[1.0]]
    calls = [(problem, *pair, ITERATIONS) for pair in itertools.product(states, starts)]
    return _each_once((workers or Workers()).map(adjust_narrowing, calls))


def _each_once(found: list[Found]) -> list[Found]:
    kept: list[Found] = []
    for state, report in found:
        cost = report.cost_after
        if all(abs(cost - other.cost_after) > SAME_COST * cost for _, other in kept):
            kept.append((state, report))
    return kept


def lowest_minimum(
    graph: KeyframeGraph,
    start: Callable[[float], list[BundleState]],  # log_focal -> hypotheses
    workers: Workers | None = None,
) -> Found:
    """Return the geometry of the warm-up that is most plausible, adjusted with its camera.

    The focal length stays as guessed if the motion does not tell it, and the readout at zero if it
    saves too little: a global shutter would follow noise and dynamic objects.
    """
    workers, links = workers or Workers(), range(len(graph.links))
    flow_problem = partial(bundle_problem, graph, links, first_free=0, lambda_prior=0.0)

    def adjusted(problem: BundleProblem, found: list[Found]) -> list[Found]:
        calls = [(problem, state, WIDENINGS[1:], ITERATIONS) for state, _ in found]
        return _each_once(workers.map(adjust_narrowing, calls))

    def best(found: list[Found]) -> Found:
        if not graph.seeks_focal:
            return min(found, key=cost_of)
        return most_plausible(graph.grid, graph.keyframes.prior_disparities, found)

    problem = flow_problem()
    free = replace(problem, free_focal=graph.seeks_focal)
    found = minima(problem, start(0.0), workers)
    if graph.seeks_focal:
        others = (minima(problem, start(log_focal), workers) for log_focal in OTHER_FOCALS)
        found = adjusted(free, [*found, *itertools.chain(*others)])
    chosen = best(found)
    columns = graph.shutter.link_columns(links, usual=True)
    if columns is not None:
        rolled = best(adjusted(replace(free, shutter=columns), found))
        if cost_of(rolled) < (1 - READOUT_WORTH_SAVING) * min(map(cost_of, found)):
            graph.shutter.take(rolled[0].readout, columns)
            problem = flow_problem()  # corrected
            free = replace(problem, free_focal=graph.seeks_focal)
            still = replace(rolled[0], readout=(0.0, 0.0))
            chosen = adjust_narrowing(free, still, WIDENINGS[2:], ITERATIONS)
    if not graph.seeks_focal:
        return chosen
    at_guess = replace(chosen[0], log_focal=0.0)
    held = adjust_narrowing(problem, at_guess, WIDENINGS[2:], ITERATIONS)
    fit, fitted = fit_focal_length(problem, held[0], workers, chosen[0])
    if fit.factor is not None:
        chosen = adjust_narrowing(free, fitted, WIDENINGS[2:], ITERATIONS)
    elif abs(chosen[0].log_focal) > FARTHEST or (
        cost_of(chosen) >= (1 - FOCAL_WORTH_SAVING) * cost_of(held)
    ):
        return held
    graph.focal_is_free = True
    return chosen
