"""The frame graph: its edges link covisible keyframes and hold the flow between them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.priors.interfaces import FlowMatches
from minislam.state.memory import SHELF
from minislam.state.stateful import FrameOf, Stateful, Tree
from minislam.tracking.reprojection import lengths, relative_transforms, reproject

MIN_VALID_FRACTION = 0.5  # of the cells, before the other camera, seen or not; DROID-SLAM: 0.75
FAR = math.inf  # px, the distance of a pair below this fraction
COARSE, COARSE_MARGIN = 16, 2.0  # one cell in 16 gives a distance to within a factor of 2
KEPT_FRACTION = 0.8  # of the old matched ratio: flow that matches less does not replace the old [-]
AT_ONCE = 256  # edges: 100 kB each while they are matched; even, because a pair stays together


@dataclass
class FrameGraph(Stateful):
    """Directed edges (source, target) between keyframes, each with its flow measurement."""

    ends: list[tuple[int, int]] = field(default_factory=list)
    targets: list[Tensor] = field(default_factory=list)  # per edge (2, N) px
    confidences: list[Tensor] = field(default_factory=list)  # per edge (2, N) in [0, 1]
    matched_ratios: list[float] = field(default_factory=list)  # per edge, in [0, 1]

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        super().restore_state(state, frame_of)
        SHELF.put([*self.targets, *self.confidences])

    def __len__(self) -> int:
        return len(self.ends)

    def record(self, edges: list[tuple[int, int]], matches: FlowMatches) -> None:
        """Store the matches of these edges, adding the edges that are new.

        An edge keeps its old flow if the new one matches clearly less: flow that started from a
        wrong pose fails, and the old flow is needed to correct that pose.
        """
        flows = SHELF.rows(torch.cat([matches.targets, matches.confidences], 1))
        position_of = {edge: position for position, edge in enumerate(self.ends)}
        for edge, flow, ratio in zip(edges, flows, matches.matched_ratios.tolist(), strict=True):
            target, confidence = flow[:2], flow[2:]
            position = position_of.setdefault(edge, len(self))
            if position == len(self):
                self.ends.append(edge)
                self.targets.append(target)
                self.confidences.append(confidence)
                self.matched_ratios.append(ratio)
            elif ratio >= KEPT_FRACTION * self.matched_ratios[position]:
                self.targets[position], self.confidences[position] = target, confidence
                self.matched_ratios[position] = ratio

    def remove_newest(self, count: int) -> None:
        """Remove the `count` edges that were added last."""
        for column in (self.ends, self.targets, self.confidences, self.matched_ratios):
            del column[len(column) - count :]


def neighbourhood_edges(first: int, count: int, radius: int) -> list[tuple[int, int]]:
    """Link every keyframe in [first, count) with its `radius` predecessors, in both directions."""
    pairs = [(i, j) for i in range(first, count) for j in range(max(0, i - radius), i)]
    return both_directions(pairs)


def at_once(edges: Any) -> Iterator[Any]:
    """Cut a list of edges, or a tensor with a row per edge: all at once would take gigabytes."""
    return (edges[first : first + AT_ONCE] for first in range(0, len(edges), AT_ONCE))


def both_directions(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return each pair followed by its reverse."""
    return [edge for i, j in pairs for edge in ((i, j), (j, i))]


def proximity_pairs(
    distances: Tensor,  # (K, K) px, symmetric
    existing: list[tuple[int, int]],  # edges of the graph
    candidates: range,  # the newer keyframe of a pair
    max_distance: float,  # px
    limit_per_keyframe: int,
    suppression: int = 2,  # keyframes
) -> list[tuple[int, int]]:
    """Pick pairs (newer, older) by increasing flow distance, with non-maximum suppression.

    Around every existing or chosen pair (i, j), the pairs (i + a, j + b) with |a| + |b| <=
    min(|i - j| - 2, suppression) are skipped, because they would measure nearly the same again.
    """
    free = torch.ones_like(distances, dtype=torch.bool)
    for i, j in existing:
        _suppress(free, max(i, j), min(i, j), suppression)
    rows = ((i, distances[i, :i].tolist()) for i in candidates)
    order = sorted((d, i, j) for i, row in rows for j, d in enumerate(row) if d <= max_distance)
    chosen: list[tuple[int, int]] = []
    used = dict.fromkeys(candidates, 0)
    for _, i, j in order:
        if free[i, j] and used[i] < limit_per_keyframe:
            chosen.append((i, j))
            used[i] += 1
            _suppress(free, i, j, suppression)
    return chosen


def _suppress(free: Tensor, i: int, j: int, suppression: int) -> None:
    radius = max(min(abs(i - j) - 2, suppression), 0)
    for a in range(-radius, radius + 1):
        reach = radius - abs(a)
        if 0 <= i + a < len(free):
            free[i + a, max(0, j - reach) : j + reach + 1] = False


def flow_distances(
    T_camera_world: Tensor,  # (K, 4, 4)
    disparities: Tensor,  # (K, N)
    rays: Tensor,  # (N, 3)
    pixels: Tensor,  # (N, 2) px
    camera: Camera,
    full_flow_weight: float,  # eta
    rows: range | None = None,  # keyframes to compare with all others; None: all
    limit: float = FAR,  # px: pairs that COARSE cells put beyond twice this are FAR
) -> Tensor:  # (K, K) px, FAR outside the rows and their columns
    """Return the distances between keyframes, as the mean flow that their geometry predicts.

    D = eta |flow| + (1 - eta) |flow without rotation|, averaged over the valid cells and
    both directions. Rotation counts less than translation, because it brings no parallax.
    """
    count = len(T_camera_world)
    rows = range(count) if rows is None else rows

    def directed(source: Tensor, target: Tensor) -> Tensor:  # 2 x (E,) keyframes -> (E,) px
        """Return the distance one way, FAR where too few cells lie in front of the target."""
        whole = relative_transforms(T_camera_world, source, target).to(disparities.dtype)
        without_rotation = whole.clone()
        without_rotation[:, :3, :3] = torch.eye(3, device=whole.device)
        total, valid_cells = disparities.new_zeros(2, len(source))
        for motion, weight in (whole, full_flow_weight), (without_rotation, 1 - full_flow_weight):
            positions, valid = reproject(motion, disparities[source], rays, camera)
            length = lengths(positions - pixels.T)
            total += weight * (length * valid).sum(1)
            valid_cells += weight * valid.sum(1)
        is_enough = valid_cells >= MIN_VALID_FRACTION * len(rays)
        return torch.where(is_enough, total / valid_cells.clamp_min(1), FAR)

    near = torch.ones(count, count, dtype=torch.bool, device=disparities.device)
    if limit < FAR:
        coarse = disparities[:, ::COARSE], rays[::COARSE], pixels[::COARSE]
        rough = flow_distances(T_camera_world, *coarse, camera, full_flow_weight, rows)
        near = rough < COARSE_MARGIN * limit
    distances = disparities.new_full((count, count), FAR)
    for row in rows:
        near[row, rows.start : row : rows.step] = False  # known already
        others = near[row].nonzero()[:, 0]
        this = torch.full_like(others, row)
        mean = 0.5 * (directed(this, others) + directed(others, this))
        distances[row, others] = distances[others, row] = mean
    return distances
