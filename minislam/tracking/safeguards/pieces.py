"""Which stretches of a broken trajectory belong together.

A stretch ends at a break, or where the camera was lost. Behind a loss it was found again at a place
that it had seen, perhaps long before, and edges lead there that fit. So a stretch can belong to one
before the last break, and not to the one before the loss.
"""

from collections.abc import Iterable, Sequence

from minislam.tracking.keyframe_graph import Edge, KeyframeGraph
from minislam.tracking.optimisation import bundle_problem

Span = tuple[int, int]  # first and last frame
MIN_SUPPORT = 0.5  # robust weight of an edge that fits, over its weight; of one that does not 0 [-]


def found_again(graph: KeyframeGraph) -> list[int]:
    """Return the keyframes at which a lost camera was found again."""
    return [k for k in range(len(graph.keyframes)) if graph.follows_a_loss(k)]


def edges_past_a_loss(graph: KeyframeGraph) -> list[Edge]:
    """Return the edges between keyframes before and behind a loss that fit the geometry."""
    ends, lost = graph.edges.ends, found_again(graph)
    past = [p for p, edge in enumerate(ends) if any(min(edge) < k <= max(edge) for k in lost)]
    if not past:
        return []
    problem = bundle_problem(graph, past)
    fitting = graph.fitting_weights(problem, graph.state)
    support = fitting.mean((1, 2)) / problem.weights.mean((1, 2)).clamp_min(1e-9)
    return [ends[p] for p, is_tied in zip(past, support >= MIN_SUPPORT, strict=True) if is_tied]


def pieces(
    frames: Sequence[int],  # of the keyframes
    segments: Sequence[Span],  # between the breaks
    lost: Sequence[int],  # keyframes before which the camera was lost
    edges: Iterable[Edge],  # that fit
) -> list[list[Span]]:
    """Return the groups of stretches that edges tie. An edge that only spans a break ties none."""
    stretches: list[Span] = []
    place: dict[int, tuple[int, int]] = {}  # stretch and segment, by keyframe
    for segment, (first, last) in enumerate(segments):
        inside = [k for k, frame in enumerate(frames) if first <= frame <= last]
        starts = [k for k in inside if k == inside[0] or k in lost]
        ends = [*(frames[k] - 1 for k in starts[1:]), last]
        for start, end in zip(starts, ends, strict=False):
            stretches.append((frames[start], end))
            place |= {k: (len(stretches) - 1, segment) for k in inside if k >= start}
    group = list(range(len(stretches)))
    for i, j in edges:
        if i in place and j in place:
            (a, segment_a), (b, segment_b) = place[i], place[j]
            if abs(a - b) > 1 or segment_a == segment_b:
                group = [group[a] if one == group[b] else one for one in group]
    tied = {one: [s for s, g in zip(stretches, group, strict=True) if g == one] for one in group}
    return list(tied.values())
