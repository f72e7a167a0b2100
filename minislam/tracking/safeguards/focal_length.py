"""Check of the given focal length: does the flow fit another one better?

Tracking hides a wrong focal length, because wrong rotations and depths can explain most of the
flow. The part that they cannot explain is in the residuals of the final global BA. So that BA is
repeated with shorter and longer focal lengths until the lowest cost lies between two higher
ones. The minimum of the parabola through the three is the best focal length.
"""

import math
from dataclasses import dataclass, replace

from minislam.tracking.bundle_adjustment import BundleProblem, BundleState, bundle_adjust
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem

STEP = math.log(1.05)  # between two focal lengths that are tried, 5 %
MAX_STEPS = 8  # either way, a factor of 1.48
ITERATIONS = 10  # Gauss-Newton steps at each focal length
# A camera that does not turn fits its flow with any focal length. On real video a focal length
# that was 5 % off cost 5 % more; where the camera had followed a dynamic object, 0.4 %. [-]
MIN_RISE = 0.01
# No flow is more exact than this; smaller residuals count as this. [px]
MIN_RESIDUAL = 0.05
# A warning needs a larger difference, and a larger saving of cost, than was ever measured with
# the right focal length (5.4 %, saving 1.3 %, in two seconds of real video). [-]
WORTH_SAYING, WORTH_SAVING = 0.05, 0.02


@dataclass(frozen=True)
class FocalLengthFit:
    """The focal length that the flow fits best."""

    given: float  # px, fx at the working size
    factor: float | None  # best focal length / given one; None: the motion does not tell
    saved: float  # fraction of the residual cost that the best one saves [-]

    @property
    def is_doubtful(self) -> bool:
        """Tell whether the given focal length is probably wrong: both thresholds are exceeded."""
        if self.factor is None:
            return False
        return abs(math.log(self.factor)) > WORTH_SAYING and self.saved > WORTH_SAVING


def check_focal_length(graph: KeyframeGraph) -> FocalLengthFit:
    """Fit the focal length to all links, after the final global BA; nothing is changed."""
    problem = bundle_problem(graph, range(len(graph.links)), 0, lambda_prior=0.0)
    return fit_focal_length(problem, graph.state)


def fit_focal_length(problem: BundleProblem, state: BundleState) -> FocalLengthFit:
    """Return the focal length at which the adjusted cost of all edges is lowest.

    The problem is that of the final global BA, at its minimum `state`; fx and fy keep their ratio.
    """
    results = {0: _adjust_at(problem, state, 0)}  # by steps from the given focal length
    middle = 0
    while abs(middle) < MAX_STEPS:
        for step in (middle - 1, middle + 1):
            if step not in results:
                results[step] = _adjust_at(problem, results[middle][0], step)
        best = min((middle - 1, middle, middle + 1), key=lambda step: results[step][1])
        if best == middle:
            break
        middle = best
    else:
        return FocalLengthFit(problem.camera.fx, None, 0.0)

    before, lowest, after = (results[step][1] for step in (middle - 1, middle, middle + 1))
    slope, rise = (after - before) / 2, (after + before) / 2 - lowest
    floor = MIN_RESIDUAL**2 * float(problem.weights.mean(1).sum())
    if rise < MIN_RISE * max(lowest, floor):
        return FocalLengthFit(problem.camera.fx, None, 0.0)
    factor = math.exp(STEP * (middle - slope / (2 * rise)))
    saved = results[0][1] - lowest + slope**2 / (4 * rise)
    return FocalLengthFit(problem.camera.fx, factor, saved / max(results[0][1], floor))


def _adjust_at(problem: BundleProblem, start: BundleState, step: int) -> tuple[BundleState, float]:
    """Return the state and the cost [px^2] with the focal length changed by so many steps."""
    scale, camera = math.exp(step * STEP), problem.camera
    problem = replace(
        problem,
        camera=replace(camera, fx=scale * camera.fx, fy=scale * camera.fy),
        rays=problem.rays * problem.rays.new_tensor([1 / scale, 1 / scale, 1.0]),
    )
    state, report = bundle_adjust(problem, start, ITERATIONS)
    return state, report.cost_after
