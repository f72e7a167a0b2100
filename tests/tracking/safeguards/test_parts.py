"""Edges in parts: the same numbers as with all at once."""

import pytest
import torch

from minislam.tracking.bundle_adjustment import bundle_adjust, edge_costs, residuals
from minislam.tracking.safeguards import parts
from minislam.tracking.safeguards.parts import in_parts
from tests.tracking.scene import CELLS, known_problem, noisy, perturbed


def test_each_edge_is_in_one_part_with_all_edges_of_its_source(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(parts, "CELLS_AT_ONCE", 4 * CELLS)
    problem = known_problem(4).problem  # 3 edges per source
    found = list(in_parts(problem))
    assert len(found) == 3 and torch.equal(
        torch.cat([edges for edges, _ in found]).sort().values, torch.arange(12)
    )
    sources = [set(part.edges_source.tolist()) for _, part in found]
    assert sum(map(len, sources)) == 4
    for edges, part in found:
        assert torch.equal(part.targets, problem.targets[edges])


def test_few_edges_are_not_copied():
    problem = known_problem(4).problem
    ((edges, part),) = in_parts(problem)
    assert part is problem and edges.tolist() == list(range(12))


def test_an_adjustment_in_parts_is_that_of_all_edges(monkeypatch: pytest.MonkeyPatch):
    known = known_problem(4)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    whole, report = bundle_adjust(problem, start, 4)
    costs, rest = edge_costs(problem, start), residuals(problem, start)
    monkeypatch.setattr(parts, "CELLS_AT_ONCE", 4 * CELLS)
    split, again = bundle_adjust(problem, start, 4)
    torch.testing.assert_close(split.T_camera_world, whole.T_camera_world, rtol=0, atol=1e-12)
    torch.testing.assert_close(split.disparities, whole.disparities, rtol=0, atol=1e-12)
    assert again.cost_after == pytest.approx(report.cost_after, rel=1e-12)
    assert torch.equal(edge_costs(problem, start), costs)
    assert all(torch.equal(a, b) for a, b in zip(residuals(problem, start), rest, strict=True))
