"""A problem in parts or of a part: the same numbers as with all at once."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from minislam.state import memory, threads
from minislam.tracking import optimisation
from minislam.tracking.bundle_adjustment import (
    bundle_adjust,
    edge_costs,
    normal_equations,
    residuals,
)
from minislam.tracking.optimisation import adjust_touched, touched_rows
from minislam.tracking.safeguards import parts
from minislam.tracking.safeguards.parts import in_parts, of_cells
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


def test_between_many_parts_memory_is_given_back(monkeypatch: pytest.MonkeyPatch):
    given: list[None] = []
    monkeypatch.setattr(parts, "give_back_freed", lambda: given.append(None))
    monkeypatch.setattr(parts, "CELLS_AT_ONCE", 4 * CELLS)
    for untidied, times in ((3, 0), (2, 2)):  # of three parts, the first and the third
        monkeypatch.setattr(parts, "PARTS_UNTIDIED", untidied)
        list(in_parts(known_problem(4).problem))
        assert len(given) == times


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


def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch):
    known = known_problem(6)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    monkeypatch.setattr(parts, "CELLS_AT_ONCE", 5 * CELLS)  # six parts, of one source each
    monkeypatch.setattr(threads, "_POOL", ThreadPoolExecutor(1))
    one, report = bundle_adjust(problem, start, 4)
    monkeypatch.setattr(threads, "_POOL", ThreadPoolExecutor(4))
    many, again = bundle_adjust(problem, start, 4)
    assert torch.equal(one.T_camera_world, many.T_camera_world)
    assert torch.equal(one.disparities, many.disparities) and report == again


def test_couplings_in_a_file_are_those_in_memory(monkeypatch: pytest.MonkeyPatch):
    known = known_problem(4)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    whole, _ = bundle_adjust(problem, start, 4)
    monkeypatch.setattr(parts, "CELLS_COUPLED", 12 * CELLS - 1)
    monkeypatch.setattr(memory, "SMALLEST", 1)
    blocks = normal_equations(problem, start).source_blocks
    assert len(list(blocks)) == 4 and all(blocks._shelf.holds(E) for _, _, E in blocks)
    in_file, _ = bundle_adjust(problem, start, 4)
    assert torch.equal(in_file.T_camera_world, whole.T_camera_world)
    assert torch.equal(in_file.disparities, whole.disparities)
    monkeypatch.setattr(parts, "CELLS_COUPLED", 12 * CELLS)
    assert normal_equations(problem, start).source_blocks._shelf is None


def test_rows_that_nothing_touches_stay_and_the_others_move_as_in_the_whole(
    monkeypatch: pytest.MonkeyPatch,
):
    known = known_problem(5)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    chosen = ((problem.edges_source != 1) & (problem.edges_target != 1)).nonzero()[:, 0]
    ends = problem.edges_source[chosen], problem.edges_target[chosen]
    free = problem.free_disparities & (torch.arange(5) != 1)
    problem = replace(
        problem,
        edges_source=ends[0],
        edges_target=ends[1],
        targets=problem.targets[chosen],
        weights=problem.weights[chosen],
        free_poses=problem.free_poses & free,
        free_disparities=free,
    )
    assert touched_rows(problem).tolist() == [0, 1, 2, 3, 4]  # so few are not selected
    monkeypatch.setattr(optimisation, "FEW_KEYFRAMES", 4)
    assert touched_rows(problem).tolist() == [0, 2, 3, 4]
    (state, _), (whole, _) = (f(problem, start, 3) for f in (adjust_touched, bundle_adjust))
    torch.testing.assert_close(state.T_camera_world, whole.T_camera_world, rtol=0, atol=1e-12)
    torch.testing.assert_close(state.disparities, whole.disparities, rtol=0, atol=1e-12)
    assert torch.equal(state.disparities[1], start.disparities[1])


def test_cells_alone_are_adjusted_as_if_the_others_weighed_nothing():
    known = known_problem(3)
    problem, start = noisy(known, 1.0), perturbed(known, 0.02)
    cells = torch.arange(0, len(problem.rays), 3)
    others = torch.ones(len(problem.rays), dtype=torch.bool)
    others[cells] = False
    problem = replace(problem, robust=None)
    weights = torch.where(others, 0, problem.weights)
    priors = torch.where(others, 0, problem.prior_weights)
    whole = replace(problem, weights=weights, prior_weights=priors)
    damping = torch.full_like(start.disparities, 1e-3)  # else it is a fraction of the mean cell's
    part, whole = (replace(p, disparity_damping=damping) for p in (problem, whole))
    (state, report), (expected, _) = (
        bundle_adjust(*some, 3) for some in (of_cells(part, start, cells), (whole, start))
    )
    assert report.iterations == 3
    torch.testing.assert_close(state.T_camera_world, expected.T_camera_world, rtol=0, atol=1e-6)
    torch.testing.assert_close(state.disparities, expected.disparities[:, cells])
