"""How exactly the scale is handed on: against noise that is drawn, and against differences."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleState,
    bundle_adjust,
    normal_equations,
)
from minislam.tracking.safeguards.scale_certainty import (
    REACH,
    _log_ratio_gradients,
    _variance,
    scale_deviations,
)
from minislam.tracking.schur import marginalised
from tests.pretended_gpu import GPU, pretended_gpu
from tests.tracking.scene import KnownProblem, known_problem, noisy, scaled

KEYFRAMES, SIGMA, DRAWS = 10, 0.3, 100


def chain(count: int = KEYFRAMES) -> KnownProblem:
    """Return a walk whose keyframes have edges to the two before and after them, all alike."""
    known = known_problem(count)
    problem = known.problem
    near = ((problem.edges_source - problem.edges_target).abs() <= 2).nonzero()[:, 0]
    problem = replace(
        problem,
        edges_source=problem.edges_source[near],
        edges_target=problem.edges_target[near],
        targets=problem.targets[near],
        weights=torch.ones_like(problem.weights[near]),
    )
    return replace(known, problem=problem)


def weakly_joined(problem: BundleProblem, middle: int, weight: float) -> BundleProblem:
    """Return the problem with edges of this weight between keyframes before and after one."""
    sides = [(ends > middle).int() - (ends < middle).int() for ends in
             (problem.edges_source, problem.edges_target)]  # fmt: skip
    crossing = sides[0] * sides[1] <= 0
    crossing &= (problem.edges_source > middle) | (problem.edges_target > middle)
    weights = torch.where(crossing[:, None, None], weight * problem.weights, problem.weights)
    return replace(problem, weights=weights)


def log_ratio(state: BundleState, keyframe: int, truth: BundleState) -> float:
    """Return ln(length after / length before), between the keyframes that the truth says."""
    far, centres = (se3_inverse(s.T_camera_world)[:, :3, 3] for s in (truth, state))
    usual = (far[REACH:] - far[:-REACH]).norm(dim=1).median()
    after = next(k for k in range(keyframe, KEYFRAMES) if (far[k] - far[keyframe]).norm() >= usual)
    before = next(k for k in range(keyframe, -1, -1) if (far[k] - far[keyframe]).norm() >= usual)
    lengths = [(centres[end] - centres[keyframe]).norm() for end in (after, before)]
    return float((lengths[0] / lengths[1]).log())


def test_the_gradient_is_that_of_the_lengths():
    state = chain().truth
    found = dict(_log_ratio_gradients(state))
    assert set(found) and set(found) <= set(range(1, KEYFRAMES - 1))
    for keyframe, gradient in found.items():
        for pose in range(KEYFRAMES):
            for unknown in range(6):
                xi = torch.zeros(2, 6, dtype=torch.float64)
                xi[:, unknown] = torch.tensor([1e-6, -1e-6])
                values = []
                for step in se3_exp(xi):
                    poses = state.T_camera_world.clone()
                    poses[pose] = step @ poses[pose]
                    moved = replace(state, T_camera_world=poses)
                    values.append(log_ratio(moved, keyframe, state))
                slope = (values[0] - values[1]) / 2e-6
                assert slope == pytest.approx(float(gradient[pose, unknown]), abs=1e-7)


def test_it_is_how_far_noise_spreads_the_lengths():
    known = chain()
    predicted = scale_deviations(noisy(known, SIGMA), known.truth)
    problems = [noisy(known, SIGMA, seed) for seed in range(DRAWS)]
    states = [bundle_adjust(problem, known.truth, 4)[0] for problem in problems]
    assert predicted
    for keyframe, deviation in predicted.items():
        ratios = torch.tensor([log_ratio(state, keyframe, known.truth) for state in states])
        assert deviation == pytest.approx(float(ratios.std()), rel=0.2)


def test_a_scale_that_few_measurements_hand_on_is_less_certain():
    known = chain()
    problem = noisy(known, SIGMA)
    state, _ = bundle_adjust(problem, known.truth, 4)
    certain = scale_deviations(problem, state)
    middle = sorted(certain)[len(certain) // 2]
    weak = weakly_joined(problem, middle, 0.001)
    doubtful = scale_deviations(weak, state)
    assert set(doubtful) == set(certain)
    assert doubtful[middle] > 3 * certain[middle]


def exactly(problem: BundleProblem, state: BundleState) -> float:
    """Return the largest deviation by the pseudo-inverse, undamped and in float64."""
    names = "rays targets weights prior_disparities prior_weights".split()
    problem = replace(problem, **{name: getattr(problem, name).double() for name in names})
    state = replace(state, disparities=state.disparities.double())
    equations = normal_equations(problem, state)
    S, _ = marginalised(problem, equations, equations.disparity_diagonal.reciprocal())
    covariance = _variance(problem, state) * torch.linalg.pinv(S, rtol=1e-12, hermitian=True)
    gradients = [gradient[1:].flatten() for _, gradient in _log_ratio_gradients(state)]
    return max(float(g @ covariance @ g) ** 0.5 for g in gradients)


@pytest.mark.parametrize("count", [12, 40])
def test_what_few_measurements_tell_is_exact_in_long_clips_too(count: int):
    known = chain(count)
    weak = weakly_joined(noisy(known, SIGMA), count // 2, 1e-4)
    found = max(scale_deviations(weak, known.truth).values())
    assert found == pytest.approx(exactly(weak, known.truth), rel=0.1)


def test_it_knows_no_unit_of_length():
    known = chain()
    problem = noisy(known, SIGMA)
    state, _ = bundle_adjust(problem, known.truth, 4)
    large = scale_deviations(problem, scaled(state, 20.0))
    assert large == pytest.approx(scale_deviations(problem, state), rel=1e-3)


def test_twice_the_weight_is_half_the_variance_and_cells_without_weight_do_not_matter():
    known = chain()
    problem = noisy(known, SIGMA)
    twice = scale_deviations(replace(problem, weights=2 * problem.weights), known.truth)
    once = scale_deviations(problem, known.truth)
    assert twice == pytest.approx({k: found / 2**0.5 for k, found in once.items()}, rel=1e-3)
    weights = problem.weights.clone()
    weights[:, :, :3] = 0
    fewer = scale_deviations(replace(problem, weights=weights), known.truth)
    assert fewer == pytest.approx(once, rel=0.3)


def test_without_a_path_or_without_any_weight_nothing_is_told():
    known = chain()
    assert scale_deviations(known_problem(REACH).problem, known_problem(REACH).truth) == {}
    poses = known.truth.T_camera_world.clone()
    poses[:, :3, 3] = 0
    resting = replace(known.truth, T_camera_world=poses)
    assert (
        list(_log_ratio_gradients(resting)) == [] and scale_deviations(known.problem, resting) == {}
    )
    nothing = replace(known.problem, weights=0 * known.problem.weights)
    assert scale_deviations(nothing, known.truth) == {}


def test_on_a_gpu_it_is_as_certain_as_on_the_cpu():
    known = chain()
    problem, state = noisy(known, SIGMA), known.truth
    expected = scale_deviations(problem, state)
    with pretended_gpu():
        there = {k: v.to(GPU) for k, v in vars(problem).items() if isinstance(v, Tensor)}
        moved = (state.T_camera_world.to(GPU), state.disparities.to(GPU))
        assert scale_deviations(replace(problem, **there), BundleState(*moved)) == expected


def test_where_the_camera_rests_lengths_lead_beyond_the_rest():
    poses = chain().truth.T_camera_world.clone()
    poses[4:7, :3, 3] = poses[4, :3, 3]
    poses[4:7, :3, :3] = poses[4, :3, :3]
    state = replace(chain().truth, T_camera_world=poses)
    for keyframe, gradient in _log_ratio_gradients(state):
        moving = set(gradient.abs().sum(1).nonzero()[:, 0].tolist())
        assert len(moving) == 3 and keyframe in moving
        assert len(moving & {4, 5, 6}) <= 1
