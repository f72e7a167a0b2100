"""How well each keyframe is tied to the others: what a person would look at when a run fails.

Scale breaks without a residual to see where the camera turns and hardly moves, or where little
can be matched: a low matched share, low weights and little parallax are the signs.
"""

from dataclasses import dataclass

from minislam.tracking.backend import BackEnd
from minislam.tracking.bundle_adjustment import residuals
from minislam.tracking.reprojection import lengths


@dataclass(frozen=True)
class KeyframeHealth:
    """What the links of one keyframe say, after its adjustment."""

    keyframe_index: int
    frame_index: int
    matched_ratio: float  # of its cells, in the best of its links [-]
    mean_weight: float  # over cells and links, robust weight included [-]
    median_residual: float  # px, of the cells that are trusted
    parallax: float  # px, the most that translation contributes to the flow of a link


def health_of(backend: BackEnd, keyframe: int) -> KeyframeHealth:
    """Judge a keyframe by its links."""
    frame_index = backend.keyframes.frames[keyframe].frame_index
    links = [p for p, edge in enumerate(backend.graph.edges()) if keyframe in edge]
    if not links:
        return KeyframeHealth(keyframe, frame_index, 0.0, 0.0, 0.0, 0.0)
    problem = backend.problem(links, first_free=0)
    residual, weight = residuals(problem, backend.state)
    length, weight = lengths(residual), weight.mean(1)
    trusted = weight > 0.5 * weight.amax()
    parallax = backend.parallaxes(problem.edges_source, problem.edges_target)
    return KeyframeHealth(
        keyframe,
        frame_index,
        matched_ratio=max(backend.graph.matched_ratios[p] for p in links),
        mean_weight=float(weight.mean()),
        median_residual=float(length[trusted].median()) if bool(trusted.any()) else 0.0,
        parallax=float(parallax.max()),
    )
