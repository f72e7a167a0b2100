"""Right and wrong answers to the exercises that build: the Gauss-Newton loop, and the mask M."""

import numpy as np
import pytest
import torch

from minislam.checks import check_bundle_adjustment, check_prior_mask, check_robust_weight
from minislam.geometry import se3_adjoint, se3_exp, se3_inverse, transform_points
from minislam.tracking.bundle_problem import BundleState
from minislam.tracking.reprojection import relative_transforms, reproject_with_jacobians
from tests.helpers import assert_variants


def equations(problem, state, weights, source_sign):
    """Return J^T W J and J^T W r of all unknowns: 6 K of the poses, then K N disparities."""
    K, N = state.disparities.shape
    source, target = problem.edges_source, problem.edges_target
    T = relative_transforms(state.T_camera_world, source, target)
    at = reproject_with_jacobians(T, state.disparities[source], problem.rays, problem.camera)
    r = problem.targets - at.positions
    left, right = r.new_zeros(6 * K + K * N, 6 * K + K * N), r.new_zeros(6 * K + K * N)
    for e, (i, j) in enumerate(zip(source.tolist(), target.tolist(), strict=True)):
        J = r.new_zeros(2, N, 6 * K + K * N)
        J_target = at.J_target[e].permute(1, 2, 0)
        J[..., 6 * j : 6 * j + 6] = J_target
        J[..., 6 * i : 6 * i + 6] = source_sign * J_target @ se3_adjoint(T[e])
        cells = torch.arange(N)
        J[:, cells, 6 * K + N * i + cells] = at.J_disparity[e]
        J, w = J.flatten(0, 1), weights[e].flatten()
        left += J.T @ (w[:, None] * J)
        right += J.T @ (w * r[e].flatten())
    return left, right


def adjusted(
    problem, state, steps, damping,
    weighted=True, held=True, sign=1, on_left=True, most=99, source_sign=-1, schur=False,
    of_poses=1, of_cells=1,
):  # fmt: skip
    """Return the state after Gauss-Newton steps, all unknowns at once or by `schur`."""
    K = len(problem.free_poses)
    weights = problem.weights if weighted else torch.ones_like(problem.weights)
    free = torch.ones(6 * K + state.disparities.numel(), dtype=torch.bool)
    if held:
        free[: 6 * K] = problem.free_poses.repeat_interleave(6)
    for _ in range(min(steps, most)):
        N, b = equations(problem, state, weights, source_sign)
        added = torch.full((len(N),), damping * of_cells).double()
        added[: 6 * K] = damping * of_poses
        N = (N + added.diag())[free][:, free]
        step = torch.zeros_like(b)
        if schur:
            P = int(free[: 6 * K].sum())
            E, C, b = N[:P, P:], N[P:, P:].diagonal(), b[free]
            xi = torch.linalg.solve(N[:P, :P] - E / C @ E.T, b[:P] - E @ (b[P:] / C))
            step[free] = torch.cat([xi, (b[P:] - E.T @ xi) / C])
        else:
            step[free] = torch.linalg.solve(N, b[free])
        exp = se3_exp(sign * step[: 6 * K].view(K, 6))
        T = state.T_camera_world
        T = exp @ T if on_left else T @ exp
        d = state.disparities + sign * step[6 * K :].view_as(state.disparities)
        state = BundleState(T, d)
    return state


def with_change(**change):
    return lambda *arguments: adjusted(*arguments, **change)


@pytest.mark.slow
@pytest.mark.ex05_3
def test_bundle_adjustment():
    right = {"all at once": adjusted, "Schur complement": with_change(schur=True)}
    wrong = {
        "weights ignored": with_change(weighted=False),
        "held poses move": with_change(held=False),
        "uphill": with_change(sign=-1),
        "step on the right": with_change(on_left=False),
        "one step": with_change(most=1),
        "source as target": with_change(source_sign=1),
        "H alone is damped": with_change(of_cells=1e-10),
        "C alone is damped": with_change(of_poses=1e-10),
        "one damping": lambda p, s, n, damping: adjusted(p, s, n, 10.0),
        "no damping": lambda p, s, n, damping: adjusted(p, s, n, 1e-9),
        "poses alone": lambda p, s, n, m: BundleState(
            adjusted(p, s, n, m).T_camera_world, s.disparities
        ),
        "disparities alone": lambda p, s, n, m: BundleState(
            s.T_camera_world, adjusted(p, s, n, m).disparities
        ),
    }
    assert_variants(check_bundle_adjustment, right, wrong)
    assert "use the argument" in check_bundle_adjustment(wrong["one damping"]).hint
    two = check_bundle_adjustment(lambda *a: adjusted(*a).T_camera_world)
    assert "expected 2: poses, disparities" in two.sentence


def arriving(seen, T_this_other, camera, stride, nearest=True, known=True, before=True):
    """Return the depth that arrives at each cell, inf where none does."""
    pixels = camera.pixel_grid(dtype=seen.dtype).flatten(0, 1)
    points = transform_points(T_this_other, camera.backproject(pixels, seen.flatten()))
    shape = len(range(0, camera.height, stride)), len(range(0, camera.width, stride))
    depth = torch.full(shape, torch.inf, dtype=seen.dtype)
    u, v = camera.project(points).round().T
    known = ((seen.flatten() > 0) | (not known)) & ((points[:, 2] > 0) | (not before))
    known &= (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    for n in (known & (u % stride == 0) & (v % stride == 0)).nonzero().flatten().tolist():
        cell = int(v[n]) // stride, int(u[n]) // stride
        depth[cell] = min(points[n, 2], depth[cell]) if nearest else points[n, 2]
    return depth


def voted(
    depth, others, camera, stride, error,
    seen_by=2, agreeing=2, change=lambda T: T, by_own=False, **arrival,
):  # fmt: skip
    cells = depth[::stride, ::stride]
    warped = [arriving(seen, change(T), camera, stride, **arrival) for seen, T in others]
    both = [(cells > 0) & w.isfinite() for w in warped]
    agree = [
        b & ((cells - w).abs() < error * (cells if by_own else w))
        for b, w in zip(both, warped, strict=True)
    ]
    seen_often = sum(b.long() for b in both) >= seen_by
    return ~seen_often | (sum(a.long() for a in agree) >= agreeing)


def in_numpy(depth, others, camera, stride, error):
    return voted(depth, others, camera, stride, error).numpy().astype(np.float32)


@pytest.mark.ex05b_2
def test_prior_mask():
    right = {"loop": voted, "numpy": in_numpy}
    wrong = {
        "seen or not": lambda *a: voted(*a, seen_by=0),
        "opposite": lambda *a: ~voted(*a),
        "back instead of forth": lambda *a: voted(*a, change=se3_inverse),
        "one is enough": lambda *a: voted(*a, agreeing=1),
        "absolute error": lambda *a: voted(*a[:-1], a[-1] / 3),
        "last instead of nearest": lambda *a: voted(*a, nearest=False),
        "always": lambda *a: voted(*a) | True,
        "unknown depth as well": lambda *a: voted(*a, known=False),
        "behind the camera": lambda *a: voted(*a, before=False),
        "no prior without a depth": lambda d, o, c, n, e: voted(d, o, c, n, e) & (d[::n, ::n] > 0),
        "one stride": lambda d, o, c, n, e: voted(d, o, c, 4, e),
        "one epsilon": lambda *a: voted(*a[:-1], 0.02),
        "relative to the own depth": lambda *a: voted(*a, by_own=True),
    }
    assert_variants(check_prior_mask, right, wrong, named=0.7)
    assert "one epsilon of many" in check_prior_mask(wrong["one epsilon"]).hint


def robust(r, c, p):
    return (1 + (r**2).sum(1) / c**2) ** -p


def robust_in_a_loop(r, c, p):
    return [1 / (1 + (float(u) ** 2 + float(v) ** 2) / c**2) ** p for u, v in r]


@pytest.mark.ex05b_1
def test_robust_weight():
    wrong = {
        "always Cauchy": lambda r, c, p: robust(r, c, 1),
        "no c": lambda r, c, p: robust(r, 1, p),
        "c not squared": lambda r, c, p: robust(r, c**0.5, p),
        "other sign": lambda r, c, p: robust(r, c, -p),
        "pull": lambda r, c, p: robust(r, c, p) * r.norm(dim=1),
        "one for u, one for v": lambda r, c, p: (1 + r**2 / c**2) ** -p,
        "r not squared": lambda r, c, p: (1 + r.norm(dim=1) / c**2) ** -p,
        "no 1": lambda r, c, p: ((r**2).sum(1) / c**2) ** -p,
    }
    assert_variants(check_robust_weight, {"torch": robust, "loop": robust_in_a_loop}, wrong)
