"""A bundle problem restricted to some edges, keyframes or cells.

Edges are processed in parts, because the derivatives of thousands of edges at once would take
gigabytes, and because arrays of a few megabytes reuse memory that was freed before.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from minislam.state.memory import Shelf, give_back_freed, release
from minislam.tracking.bundle_problem import BundleProblem, BundleState

CELLS_AT_ONCE = 50_000  # of all edges of a part: 200 bytes a cell
PARTS_UNTIDIED = 16  # parts after which freed memory is given back: it fragments
CELLS_COUPLED = 3_000_000  # of all edges whose couplings are in memory: 24 bytes a cell
_OF_EDGES = "edges_source edges_target targets weights shift_columns"
_OF_KEYFRAMES = "prior_disparities prior_weights free_poses free_disparities disparity_damping"
_OF_CELLS = "targets weights shift_columns prior_disparities prior_weights disparity_damping"

Start = tuple[BundleProblem, BundleState]  # a problem, and the state it is adjusted from


class SourceBlocks:
    """Couplings of disparities and poses by source frame; those of thousands of edges in a file."""

    def __init__(self, problem: BundleProblem) -> None:
        self._blocks: list[tuple[int, Tensor, Tensor]] = []
        self._shelf = Shelf() if problem.weights[:, 0].numel() > CELLS_COUPLED else None

    def add(self, blocks: list[tuple[int, Tensor, Tensor]]) -> None:
        """Append the blocks of some source frames: k, rows (R,), E_k (R, N)."""
        self._blocks += blocks
        if self._shelf:
            self._shelf.put(E for _, _, E in blocks)

    def __iter__(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        for block in self._blocks:
            yield block
            if self._shelf:
                release()


def in_parts(problem: BundleProblem) -> Iterator[tuple[Tensor, BundleProblem]]:
    """Yield positions (E',) of some edges, and the problem of these edges alone.

    The edges of one source stay together, because its disparities couple them.
    """
    if not len(problem.edges_source):
        yield problem.edges_source, problem
        return
    counts = torch.bincount(problem.edges_source).cumsum(0)
    part_of = ((counts - 1) * len(problem.rays) // CELLS_AT_ONCE)[problem.edges_source]
    for part in (parts := part_of.unique()):
        if len(parts) > PARTS_UNTIDIED and part % PARTS_UNTIDIED == 0:
            give_back_freed()
        edges = (part_of == part).nonzero()[:, 0]
        is_all = len(edges) == len(part_of)
        yield edges, problem if is_all else replace(problem, **_chosen(problem, _OF_EDGES, edges))


def joined(parts: Iterable[tuple[Tensor, ...]]) -> list[Tensor]:
    """Return the values of all edges, column by column, from parts (positions, values, ...)."""
    edges, *columns = zip(*parts, strict=True)
    order = torch.cat(edges).argsort()
    return [torch.cat(column)[order] for column in columns]


def of_rows(problem: BundleProblem, state: BundleState, rows: Tensor) -> Start:
    """Return problem and state of some keyframes (K',) alone; all edges must be among them."""
    values = _chosen(problem, _OF_KEYFRAMES, rows)
    for name in ("edges_source", "edges_target"):
        values[name] = torch.searchsorted(rows, getattr(problem, name).contiguous())
    poses, disparities = state.T_camera_world[rows], state.disparities[rows]
    state = replace(state, T_camera_world=poses, disparities=disparities)
    return replace(problem, **values), state


def of_cells(problem: BundleProblem, state: BundleState, cells: Tensor) -> Start:
    """Return problem and state of some cells (N',) of the grid alone."""
    values = _chosen(problem, _OF_CELLS, (..., cells))
    problem = replace(problem, rays=problem.rays[cells], **values)
    return problem, replace(state, disparities=state.disparities[:, cells])


def _chosen(problem: BundleProblem, names: str, index: Any) -> dict[str, Any]:
    """Return these columns of a problem at an index; one that is None stays None."""
    chosen = {}
    for name in names.split():
        column = getattr(problem, name)
        chosen[name] = None if column is None else column[index]
        release()
    return chosen
