"""How well each keyframe is tied to the others, and where the trajectory breaks.

With a low matched ratio or little parallax the scale can drift while all residuals stay small.
Where everything is matched, five measurements tell broken keyframes from healthy ones: those of
`KeyframeDiagnostics` from `explained` on (tests/benchmarks/diary/broken_runs.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import torch
from torch import Tensor

from minislam.state.stateful import Stateful
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.optimisation import bundle_problem
from minislam.tracking.reprojection import lengths
from minislam.tracking.safeguards.depth_agreement import depth_difference, seen_and_expected
from minislam.tracking.safeguards.motion_memory import arrived, inherit_motion_weight
from minislam.tracking.safeguards.pieces import edges_past_a_loss, found_again, pieces
from minislam.tracking.safeguards.robust import weighted_median
from minislam.tracking.safeguards.scale_certainty import scale_deviations
from minislam.tracking.safeguards.turns import flow_beyond_turns, fraction_at_rest

LOOK_BACK = 3  # keyframes before one that it is judged by
EXPLAINED = 2.0  # px at 320x240 and in smaller images: a residual that the geometry explains
MIN_EXPLAINED = 0.5  # of the matched flow; healthy .88 to 1, two in a row .68, broken .24 to .4
MIN_EXPLAINED_LONG, LONG = 0.85, 3  # of so many keyframes in a row one must explain more
MIN_EXPLAINED_AT_ONCE = 0.35  # when a keyframe has just come; broken .15 to .32
MAX_DEPTH_ERROR = 0.2  # relative; healthy .003 to .15, broken .5
MIN_CONTINUITY = 0.0155  # healthy .07 and more, .018 in a fast turn; broken 0 to .014
MIN_AGREEMENT = 0.45  # healthy .49 to 1, broken 0 to .41
MAX_SCALE_DEVIATION = 0.1  # of a length, relative; healthy to .06, broken .19 and .40
CERTAIN_SCALE_DEVIATION = 0.03  # photos from far apart that were posed well to .013
MIN_EVIDENCE, LEAST_CELLS = 0.005, 1.5  # of the view, and cells, that an agreement needs
HEALED_AFTER = 3  # healthy keyframes that end a break
LEAST_FRAMES = 6  # with a pose, of a piece that gets a map of its own

# A camera that walks; the tables stand in tests/benchmarks/diary/turning_cameras.md.
LEAST_BEYOND_TURNS = 0.45  # px of a 320x240 image
MOST_RESTING = 0.75  # fraction of the keyframes: cameras that stand .88 to 1, pans 0 to .16 [-]
MOST_DIFFERENCE = 0.2  # relative, of depths by earlier and by later keyframes (broken_runs.md)
LEAST_CONFIRMED = 0.15  # fraction of the cells: a hand-held camera .05, pans .24 and more [-]


@dataclass(frozen=True)
class KeyframeDiagnostics:
    """How one keyframe is tied to the others, after its adjustment or after the final one."""

    frame_index: int
    matched_ratio: float  # in the best edge from or to it [-]
    parallax: float  # px, the largest mean flow by translation alone among its edges
    explained: float | None  # of the matched flow from its predecessors; None: no edge
    depth_error: float | None  # median relative difference from them; None: no common cell
    continuity: float | None  # see `continuity`; None: an edge is missing [-]
    agreement: float | None  # see `continuity`; None: also if too few cells are known [-]
    scale_deviation: float | None = None  # standard deviation of ln(length after / before) [-]


@dataclass(frozen=True)
class Break:
    """Keyframes whose poses fit neither those before nor those after."""

    first_frame: int
    last_frame: int


class Watch(Stateful):
    """Judges each keyframe when it comes, and all of them at the end."""

    diagnostics: list[KeyframeDiagnostics]
    breaks: list[Break]  # known at the end, because the newest depths are rough
    beyond_turns: float | None = None  # px of a 320x240 image, at the end: `flow_beyond_turns`
    depth_difference: float | None = None  # at the end: `depth_agreement.py` [-]
    resting: float = 0.0  # fraction of the keyframes, at the end: `fraction_at_rest` [-]
    confirmed: float = 1.0  # fraction of all cells that sweeps confirm, once they have swept [-]

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        self.diagnostics, self.breaks = [], []

    def judge(self, first: int = 0) -> None:
        """Replace the diagnostics of the keyframes from `first` on by their present ones."""
        keyframes = range(first, len(self._graph.keyframes))
        self.diagnostics[first:] = [diagnose(self._graph, keyframe) for keyframe in keyframes]

    def conclude(self) -> None:
        """Judge all keyframes after the final adjustment, and find the breaks."""
        self.judge()
        graph, judged = self._graph, self.diagnostics
        self.beyond_turns, self.resting = flow_beyond_turns(graph), fraction_at_rest(graph)
        self.depth_difference = depth_difference(graph)
        if self.only_turned or (self.hardly_walked and self.has_two_depths):
            # Depths are arbitrary, and a pan leaves old cells behind.
            judged = [replace(k, depth_error=None, continuity=None) for k in judged]
        elif (self.beyond_turns or 0.0) >= LEAST_BEYOND_TURNS and not graph.keyframes.has_prior:
            found = scale_deviations(bundle_problem(graph, range(len(graph.edges))), graph.state)
            judged = [replace(k, scale_deviation=found.get(i)) for i, k in enumerate(judged)]
            self.diagnostics = judged
        self.breaks = find_breaks(judged)

    @property
    def only_turned(self) -> bool:
        """Tell whether the camera stood still or only turned, so that nothing measures depth.

        Either no pose claims parallax, or both of two keyframes rest. Or hardly any flow is beyond
        turns, and most keyframes rest or sweeps confirm hardly any depth.
        """
        rests = self.resting > MOST_RESTING
        if all(k.parallax < self._graph.least_parallax for k in self.diagnostics):
            return True
        no_depth = self.hardly_walked and (rests or self.confirmed < LEAST_CONFIRMED)
        return no_depth or (rests and len(self.diagnostics) == 2)

    @property
    def hardly_walked(self) -> bool:
        """Tell whether hardly any flow is more than a turn explains."""
        return self.beyond_turns is not None and self.beyond_turns < LEAST_BEYOND_TURNS

    @property
    def has_two_depths(self) -> bool:
        """Tell whether earlier and later views measure different depths; a prior gives them."""
        differ = (self.depth_difference or 0.0) > MOST_DIFFERENCE
        return differ and not self._graph.keyframes.has_prior

    @property
    def segments(self) -> list[tuple[int, int]]:
        """Return the first and last frame of each segment: the keyframes between two breaks."""
        breaks, frames = self.breaks, [keyframe.frame_index for keyframe in self.diagnostics]
        healthy = [i for i in frames if not any(b.first_frame <= i <= b.last_frame for b in breaks)]
        runs = groupby(healthy, lambda frame: sum(b.last_frame < frame for b in breaks))
        return [(run[0], run[-1]) for run in (list(members) for _, members in runs)]

    def longest_piece(self, poses: dict[int, Tensor]) -> dict[int, Tensor]:
        """Return, of the poses by frame index, those of the longest of the `pieces`.

        A map shows it alone, because the pieces differ in scale and direction, and each would hide
        the others. Without a break, or where all pieces are short, all poses are returned.
        """
        frames, tied = [keyframe.frame_index for keyframe in self.diagnostics], []
        if self.breaks:
            ties = found_again(self._graph), edges_past_a_loss(self._graph)
            tied = pieces(frames, self.segments, *ties)
        found = [{i: poses[i] for i in poses if any(a <= i <= b for a, b in part)} for part in tied]
        longest = max(found, key=len, default=poses)
        return longest if len(longest) >= LEAST_FRAMES else poses


def diagnose(graph: KeyframeGraph, keyframe: int) -> KeyframeDiagnostics:
    """Judge a keyframe by its edges and by its predecessors."""
    frame_index = graph.keyframes.frames[keyframe].frame_index
    edges = graph.edges.ends
    positions = [p for p, edge in enumerate(edges) if keyframe in edge]
    sources, targets = ([edges[p][end] for p in positions] for end in (0, 1))
    ratio = max((graph.edges.matched_ratios[p] for p in positions), default=0.0)
    parallax = float(graph.parallaxes(sources, targets).max()) if positions else 0.0
    ties = *tie_to_predecessors(graph, keyframe), *continuity(graph, keyframe)
    return KeyframeDiagnostics(frame_index, ratio, parallax, *ties)


def tie_to_predecessors(graph: KeyframeGraph, keyframe: int) -> tuple[float | None, float | None]:
    """Return how a keyframe agrees with the keyframes before it, over the edges between them [-].

    First the part of the flow from there, of what was static so far, that the geometry explains.
    Then the median relative difference of the depths that both ends of an edge see; near cells
    count more. None: no edge, or no cell that both see.
    """
    near = set(neighbourhood_edges(keyframe, keyframe + 1, LOOK_BACK))
    edges = graph.edges.ends
    positions = [p for p, edge in enumerate(edges) if edge in near]
    if not positions:
        return None, None
    problem = bundle_problem(graph, positions)
    residual, robust_weights = residuals(problem, graph.state)
    sources, targets = problem.edges_source, problem.edges_target
    confidences = torch.stack([graph.edges.confidences[p][0] for p in positions])
    weights = confidences * torch.stack([weight_so_far(graph, edges[p][0]) for p in positions])
    weights *= (targets == keyframe)[:, None]
    explained = float((weights * fitting(graph, residual)).sum() / weights.sum().clamp_min(1e-6))

    seen_at = (problem.targets - residual).mT
    seen, expected = seen_and_expected(graph, sources, targets, seen_at)
    counted = robust_weights[:, 0] * graph.grid.camera.contains(seen_at)
    return explained, weighted_median((seen / expected).log().abs(), counted * expected)


def continuity(graph: KeyframeGraph, keyframe: int) -> tuple[float | None, float | None]:
    """Return continuity and agreement [-]: do cells that fitted before fit in this keyframe?

    A cell of an earlier keyframe is known if its flow to the next keyframe fits; in the keyframe
    just before, the cells are known to which known ones flow.

    Continuity: the mean weight of the known cells that are matched and fit, in the best edge into
    this keyframe, over the mean confidence of the edge from the keyframe just before. Agreement:
    the fraction that fits of the known and matched cells, without motion weights, in the worst
    edge. None: an edge is missing or the camera was lost, or for agreement too few cells are known.
    """
    flow_into = dict(enumerate(graph.flow_to_next, start=1))  # by keyframe
    before, now = flow_into.get(keyframe - 1), flow_into.get(keyframe)
    sources = range(max(0, keyframe - LOOK_BACK), keyframe)
    wanted = {(i, end) for i in sources for end in (i + 1, keyframe)}
    at = {ends: p for p, ends in enumerate(graph.edges.ends) if ends in wanted}
    if before is None or now is None or len(at) < len(wanted):
        return None, None
    residual, _ = residuals(bundle_problem(graph, list(at.values())), graph.state)
    fits = dict(zip(at, fitting(graph, residual).float(), strict=True))
    known = {i: fits[i, i + 1] for i in sources[:-1]}
    known[keyframe - 1] = arrived(graph.grid, before, known[keyframe - 2])
    holding, agreeing = [], []
    for i in sources:
        static = graph.keyframes.static_weights[i]
        static = static / static.max().clamp_min(1e-6)  # small everywhere if nothing is confirmed
        matched = known[i] * static * graph.edges.confidences[at[i, keyframe]][0]
        fitted = matched * fits[i, keyframe]
        holding.append(float((fitted * graph.keyframes.motion_weights[i]).mean()))
        if matched.sum() > max(LEAST_CELLS, MIN_EVIDENCE * len(matched)):
            agreeing.append(float(fitted.sum() / matched.sum()))
    confidence = float(graph.edges.confidences[at[keyframe - 1, keyframe]][0].mean())
    return max(holding) / max(confidence, 1e-6), min(agreeing, default=None)


def fitting(graph: KeyframeGraph, residual: Tensor) -> Tensor:  # (E, 2, N) px -> (E, N) bool
    """Tell which matches the geometry explains."""
    return lengths(residual) < EXPLAINED * max(graph.pixel_scale, 1.0)


def weight_so_far(graph: KeyframeGraph, keyframe: int) -> Tensor:  # (N,)
    """Return the weight of a keyframe's cells as it was before the next keyframe judged them.

    A wrong pose lowers the motion weight of all that contradicts it. What is left agrees with it.
    """
    keyframes, matches = graph.keyframes, graph.flow_to_next[keyframe - 1] if keyframe else None
    weight = keyframes.static_weights[keyframe]
    if matches is not None:
        before = keyframes.motion_weights[keyframe - 1]
        weight = weight * inherit_motion_weight(graph.grid, matches, before)
    return weight if keyframes.overlay is None else weight * keyframes.overlay


def is_unexplained(newest: KeyframeDiagnostics) -> bool:
    """Tell whether the pose of a keyframe that has just come contradicts its flow."""
    return newest.explained is not None and newest.explained < MIN_EXPLAINED_AT_ONCE


def find_breaks(diagnostics: Sequence[KeyframeDiagnostics]) -> list[Break]:
    """Return the breaks of a trajectory from the diagnostics after the final adjustment.

    One keyframe is a break if it explains very little flow, sees other depths, or has an uncertain
    scale, low continuity or agreement; so are LONG weak ones in a row. Near breaks are joined.
    """
    found: list[Break] = []
    last = weak = 0  # broken keyframe; keyframes in a row that explain too little
    for index, keyframe in enumerate(diagnostics):
        weak = weak + 1 if _is_weak(keyframe) else 0
        if weak >= LONG or _is_broken(keyframe):
            start = index - LONG + 1 if weak >= LONG else index
            first = diagnostics[start].frame_index
            if found and start - last <= HEALED_AFTER:
                first = min(first, found.pop().first_frame)
            found.append(Break(first, keyframe.frame_index))
            last = index
    return found


def _is_weak(keyframe: KeyframeDiagnostics) -> bool:
    if keyframe.explained is None or keyframe.explained >= MIN_EXPLAINED_LONG:
        return False
    deviation = keyframe.scale_deviation
    return deviation is None or deviation >= CERTAIN_SCALE_DEVIATION


def _is_broken(keyframe: KeyframeDiagnostics) -> bool:
    ties = keyframe.explained, keyframe.continuity, keyframe.agreement
    explained, held, agreement = (1.0 if tie is None else tie for tie in ties)
    is_tied = explained >= MIN_EXPLAINED and (keyframe.depth_error or 0.0) <= MAX_DEPTH_ERROR
    has_scale = (keyframe.scale_deviation or 0.0) <= MAX_SCALE_DEVIATION
    return not (is_tied and has_scale) or held < MIN_CONTINUITY or agreement < MIN_AGREEMENT
