"""Large problems in parts: what a long sequence costs per keyframe stays the same.

The derivatives of thousands of edges at once would take gigabytes, so they are computed for some
edges after the other. A local adjustment need not pass through the rows of keyframes that it
neither moves nor sees.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from minislam.tracking.bundle_adjustment import BundleProblem, BundleState

CELLS_AT_ONCE = 300_000  # of all edges of a part: 200 bytes a cell
FEW_KEYFRAMES = 100  # so few are not worth a selection
_OF_EDGES = "edges_source", "edges_target", "targets", "weights"
_OF_KEYFRAMES = (
    "prior_disparities", "prior_weights", "free_poses", "free_disparities", "disparity_damping",
)  # fmt: skip


def in_parts(problem: "BundleProblem") -> Iterator[tuple[Tensor, "BundleProblem"]]:
    """Yield positions (E',) of some edges, and the problem of these edges alone.

    The edges of one source stay together, because its disparities couple them.
    """
    counts = torch.bincount(problem.edges_source).cumsum(0)
    number = ((counts - 1) * len(problem.rays) // CELLS_AT_ONCE)[problem.edges_source]
    for part in number.unique():
        edges = (number == part).nonzero()[:, 0]
        if len(edges) < len(number):
            yield (
                edges,
                replace(problem, **{name: getattr(problem, name)[edges] for name in _OF_EDGES}),
            )
        else:
            yield edges, problem


def joined(parts: Iterable[tuple[Tensor, ...]]) -> list[Tensor]:
    """Return each column of the rows (positions of edges, values, values, ...) for all edges."""
    edges, *columns = zip(*parts, strict=True)
    order = torch.cat(edges).argsort()
    return [torch.cat(column)[order] for column in columns]


def touched_rows(problem: "BundleProblem") -> Tensor:  # (K',) keyframe index
    """Return the keyframes that a problem moves or has an edge to; all, if there are few."""
    is_touched = problem.free_disparities.clone()
    is_touched[problem.edges_source] = is_touched[problem.edges_target] = True
    return (is_touched | (len(is_touched) <= FEW_KEYFRAMES)).nonzero()[:, 0]


def of_rows(
    problem: "BundleProblem", state: "BundleState", rows: Tensor
) -> tuple["BundleProblem", "BundleState"]:
    """Return problem and state of some keyframes (K',) alone; all edges must be among them."""
    values: dict[str, Any] = {name: getattr(problem, name) for name in _OF_KEYFRAMES}
    values = {name: None if value is None else value[rows] for name, value in values.items()}
    for name in _OF_EDGES[:2]:
        values[name] = torch.searchsorted(rows, getattr(problem, name).contiguous())
    problem = replace(problem, **values)
    poses, disparities = state.T_camera_world[rows], state.disparities[rows]
    return problem, replace(state, T_camera_world=poses, disparities=disparities)


def put_back(state: "BundleState", rows: Tensor, found: "BundleState") -> "BundleState":
    """Return the state of all keyframes with that of some of them replaced."""
    poses, disparities = state.T_camera_world.clone(), state.disparities.clone()
    poses[rows], disparities[rows] = found.T_camera_world, found.disparities
    return replace(found, T_camera_world=poses, disparities=disparities)
