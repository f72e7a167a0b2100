"""Edges in parts: the derivatives of thousands of edges at once would take gigabytes."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from minislam.tracking.bundle_adjustment import BundleProblem

CELLS_AT_ONCE = 300_000  # of all edges of a part: 200 bytes a cell
_OF_EDGES = "edges_source", "edges_target", "targets", "weights", "shutter"


def in_parts(problem: "BundleProblem") -> Iterator[tuple[Tensor, "BundleProblem"]]:
    """Yield positions (E',) of some edges, and the problem of these edges alone.

    The edges of one source stay together, because its disparities couple them.
    """
    counts = torch.bincount(problem.edges_source).cumsum(0)
    number = ((counts - 1) * len(problem.rays) // CELLS_AT_ONCE)[problem.edges_source]
    for part in number.unique():
        edges = (number == part).nonzero()[:, 0]
        if len(edges) < len(number):
            values: dict[str, Any] = {name: getattr(problem, name) for name in _OF_EDGES}
            values = {n: None if column is None else column[edges] for n, column in values.items()}
            yield edges, replace(problem, **values)
        else:
            yield edges, problem


def joined(parts: Iterable[tuple[Tensor, ...]]) -> list[Tensor]:
    """Return each column of the rows (positions of edges, values, values, ...) for all edges."""
    edges, *columns = zip(*parts, strict=True)
    order = torch.cat(edges).argsort()
    return [torch.cat(column)[order] for column in columns]
