"""Keyframes that an adjustment neither moves nor sees: the same result without them."""

from dataclasses import replace

import pytest
import torch

from minislam.tracking.bundle_adjustment import bundle_adjust
from minislam.tracking.safeguards import touched
from minislam.tracking.safeguards.touched import adjust_touched, touched_rows
from tests.tracking.scene import known_problem, noisy, perturbed


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
    monkeypatch.setattr(touched, "FEW_KEYFRAMES", 4)
    assert touched_rows(problem).tolist() == [0, 2, 3, 4]
    (state, _), (whole, _) = (f(problem, start, 3) for f in (adjust_touched, bundle_adjust))
    torch.testing.assert_close(state.T_camera_world, whole.T_camera_world, rtol=0, atol=1e-12)
    torch.testing.assert_close(state.disparities, whole.disparities, rtol=0, atol=1e-12)
    assert torch.equal(state.disparities[1], start.disparities[1])
