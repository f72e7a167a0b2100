"""How well each keyframe is tied to the others: what to look at when a run fails.

Where the camera turns but hardly moves, or where little can be matched, the scale can drift while
all residuals stay small. A low matched ratio and little parallax are the signs.
"""

from dataclasses import dataclass

import torch

from minislam.tracking.keyframe_graph import KeyframeGraph


@dataclass(frozen=True)
class KeyframeDiagnostics:
    """Matched ratio and parallax of one keyframe, after its adjustment."""

    frame_index: int
    matched_ratio: float  # of its cells, in the best of its links [-]
    parallax: float  # px, the largest mean flow by translation alone among its links


def diagnose(graph: KeyframeGraph, keyframe: int) -> KeyframeDiagnostics:
    """Return the matched ratio and the parallax of a keyframe, the best among its links."""
    frame_index = graph.keyframes.frames[keyframe].frame_index
    edges = graph.links.edges()
    positions = [p for p, edge in enumerate(edges) if keyframe in edge]
    if not positions:
        return KeyframeDiagnostics(frame_index, 0.0, 0.0)
    sources, targets = torch.tensor([edges[p] for p in positions]).unbind(1)
    ratio = max(graph.links.matched_ratios[p] for p in positions)
    return KeyframeDiagnostics(frame_index, ratio, float(graph.parallaxes(sources, targets).max()))
