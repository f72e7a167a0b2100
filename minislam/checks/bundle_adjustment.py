"""Exercises of notebooks 05 and 05b."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from minislam.checks.cases import CAMERA, Case, any_pose, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera, se3_exp, se3_inverse
from minislam.tracking import reprojection
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.disparity_prior import DepthView, depth_consistency
from minislam.tracking.grid import Grid
from minislam.tracking.reference import dense_normal_equations, moved
from minislam.tracking.safeguards.robust import RobustKernel


def check_target_jacobian(student: Function) -> Verdict:
    """Check (points X (N, 3), disparities (N,), camera) -> dp / d(rho, phi) (N, 2, 6) in px."""
    rays = CAMERA.rays(doubles([0.0, 0.0], [100.0, 52.0], [60.5, 10.25], [20.0, 40.0]))

    def reference(X: Tensor, d: Tensor, c: Camera, *, slide: Any = 1, turn: Any = 1) -> Tensor:
        # A camera that stands still sees each cell where its ray points: X = ray of the cell.
        still, depth = torch.eye(4, dtype=X.dtype)[None], X[:, 2:]
        ratio = (d / depth[:, 0])[None]
        seen = reprojection.reproject_with_jacobians(still, ratio, X / depth, c)
        J = seen.J_target[0].permute(2, 1, 0)
        return torch.cat([slide * J[..., :3], turn * J[..., 3:]], -1)

    def case(disparities: Tensor, description: str, seed: int = 0) -> Case:
        points = reprojection.scaled_points(any_pose(seed)[None], disparities[None], rays)[0].T
        return Case((points, disparities, CAMERA), description)

    cases = [
        case(doubles(1.0, 1.0, 1.0, 1.0), "disparities of 1"),
        case(doubles(0.5, 0.25, 0.8, 0.6), "any disparities"),
        case(doubles(0.0, 0.0, 0.0, 0.0), "points at infinity"),
        *drawn(lambda seed: case(normals(seed, 4).abs(), "another motion", seed)),
    ]
    mistakes = [
        (lambda X, d, c: reference(X, d**0, c), "X is d times the point: it moves by d rho."),
        (lambda *a: reference(*a, turn=-1), "The rotation is the wrong way round: -hat(X) phi."),
        (lambda *a: -reference(*a), "This is the derivative of the residual p~ - p."),
        (lambda *a: reference(*a).roll(3, -1), "The order is (rho, phi), translation first."),
        (lambda *a: reference(*a, turn=a[1][:, None, None]), "A turn moves X by phi x X: no d."),
        (lambda *a: reference(*a, turn=0), "The rotation is missing: columns 3 to 5."),
        (lambda *a: reference(*a, slide=0), "The translation is missing: columns 0 to 2."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_schur_step(student: Function) -> Verdict:
    """Check (H, E, diagonal of C, g, s) -> the steps of the poses and of the disparities."""

    def solved(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor, flaw: str = "") -> Any:
        by = C**0 if flaw == "unscaled" else C
        left = {"alone": 0, "added": -1}.get(flaw, 1) * (E / by @ E.T)
        right = {"alone": 0, "old": 0, "plus": -1}.get(flaw, 1) * (E @ (s / by))
        xi = torch.linalg.solve(H - left, g - right)
        delta = s - {"still": 0, "ahead": -1}.get(flaw, 1) * (E.T @ xi)
        return xi, delta if flaw == "undivided" else delta / C

    def case(poses: int, cells: int, description: str, seed: int = 1) -> Case:
        rows = normals(seed, 4 * cells, 6 * poses + 2)
        J, r = rows[:, 2:], rows[:, 0]
        # Each cell has four residuals, which depend on no other cell.
        mine = torch.eye(cells, dtype=torch.float64).repeat_interleave(4, 0)
        Jd = mine * rows[:, 1:2]
        return Case((J.T @ J, J.T @ Jd, Jd.square().sum(0), J.T @ r, Jd.T @ r), description)

    cases = [
        case(1, 5, "one pose and 5 cells"),
        case(3, 20, "three poses and 20 cells"),
        *drawn(lambda seed: case(2, 8 + seed % 5, f"two poses and {8 + seed % 5} cells", seed)),
    ]
    mistakes = [
        ("alone", "The disparities do not stand still: subtract E C^-1 E^T from H."),
        ("old", "The right-hand side changes too: g - E C^-1 s."),
        ("plus", "The right-hand side is g minus E C^-1 s, not plus."),
        ("still", "The disparities must follow the poses: s - E^T xi."),
        ("ahead", "The disparities follow the poses with a minus: s - E^T xi."),
        ("added", "E C^-1 E^T is subtracted from H, not added."),
        ("unscaled", "C^-1 is missing between E and E^T, and between E and s."),
        ("undivided", "The steps of the disparities are divided by C, one by one."),
        (lambda *a: solved(*a)[::-1], "The poses come first: xi, then delta."),
    ]
    return check_function(student, solved, cases, 1e-9, mistakes, ("xi", "delta"))


def check_bundle_adjustment(student: Function) -> Verdict:
    """Check (problem, state, steps, damping) -> the state after so many Gauss-Newton steps."""
    rays = CAMERA.rays(CAMERA.pixel_grid(25, torch.float64).flatten(0, 1))
    source, target = (1 - torch.eye(3)).nonzero().T

    def loop(*start: Any, flaw: str = "") -> tuple[Tensor, Tensor]:
        problem, state, steps, damping = start
        weights = problem.weights ** (flaw != "weights")
        free = problem.free_poses | (flaw == "held")
        problem = replace(problem, weights=weights, free_poses=free)
        for _ in range(min(steps, 1) if flaw == "one" else steps):
            equations = dense_normal_equations(problem, state)
            diagonal = damping * torch.ones(len(equations.vector))
            poses = 6 * int(problem.free_poses.sum())
            undamped = {"damping": slice(None), "of H": slice(poses, None), "of C": slice(poses)}
            diagonal[undamped.get(flaw, slice(0))] = 1e-9
            step = torch.linalg.solve(equations.matrix + diagonal.diag(), equations.vector)
            before = state.T_camera_world
            state = moved(problem, state, -step if flaw == "uphill" else step)
            if flaw == "right":
                poses = before @ state.T_camera_world @ se3_inverse(before)
                state = BundleState(poses, state.disparities)
        return state.T_camera_world, state.disparities

    def answered(*arguments: Any) -> Any:
        state = student(*arguments)
        is_whole = isinstance(state, BundleState)
        return (state.T_camera_world, state.disparities) if is_whole else state

    def case(
        steps: int, held: int, weights: Tensor, what: str, seed: int = 1, damping: float = 10.0
    ) -> Case:
        xi, start, noise, scatter = normals(seed, 4, 3, len(rays)).clamp(-2, 2)
        truth = BundleState(se3_exp(0.1 * xi[:, :6]), 0.5 + 0.1 * scatter.abs())
        motion = reprojection.relative_transforms(truth.T_camera_world, source, target)
        flow, _ = reprojection.reproject(motion, truth.disparities[source], rays, CAMERA)
        none, number = torch.zeros_like(scatter), torch.arange(3)
        edges, free = (source, target, flow + noise[:2], weights), (number >= held, number >= 0)
        problem = BundleProblem(CAMERA, rays, *edges, none, none, *free)
        nudged = se3_exp(0.02 * start[:, :6]) @ truth.T_camera_world
        return Case((problem, BundleState(nudged, none + 0.5), steps, damping), what)

    size = 6, 2, len(rays)
    ones, differing = torch.ones(size).double(), normals(5, *size).abs()
    hidden = ones * (torch.arange(len(rays)) > 1)
    cases = [
        case(1, 1, ones, "one step and weights of 1"),
        case(1, 2, differing, "one step, two poses held, weights that differ"),
        case(1, 1, hidden, "two cells that no other view sees"),
        case(3, 2, differing, "three steps"),
        *drawn(lambda n: case(1 + n % 2, 1, normals(n, *size).abs(), "a damping of 30", n, 30.0)),
    ]
    mistakes = [
        ("weights", "Each residual counts with its weight: J^T W J and J^T W r."),
        ("held", "A pose that is not free must not move."),
        ("uphill", "The step points uphill: with r = p~ - p it is added."),
        ("right", "The step stands on the left: exp(xi) T_camera_world."),
        ("damping", "Add the damping to the diagonals of H and of C."),
        ("of H", "The diagonal of C is damped as well, not H's alone."),
        ("of C", "The diagonal of H is damped as well, not C's alone."),
        ("one", "Repeat the step: each one linearises at the state the last one left."),
        (lambda *a: loop(*a[:-1], 10.0), "10 is one damping of many: use the argument."),
        (lambda *a: (loop(*a)[0], a[1].disparities), "The disparities move as well: + delta."),
        (lambda *a: (a[1].T_camera_world, loop(*a)[1]), "The poses move as well: exp(xi) T."),
    ]
    return check_function(answered, loop, cases, 1e-7, mistakes, ("poses", "disparities"))


def check_robust_weight(student: Function) -> Verdict:
    """Check (residuals (N, 2) [px], scale c [px], power k) -> the weight of each cell (N,)."""

    def reference(r: Tensor, c: float, k: float) -> Tensor:
        return RobustKernel(c, k).weight(r.square().sum(-1))

    cases = [
        Case((doubles([0, 0], [0.3, 0.4], [3, -4]), 2.0, 1.0), "c = 2 px and k = 1"),
        Case((2 * normals(1, 6, 2), 1.5, 2.0), "c = 1.5 px and k = 2"),
        *drawn(lambda seed: Case((normals(seed, 5, 2), 0.5, 1.5), "c = 0.5 px and k = 1.5")),
    ]
    mistakes = [
        (lambda r, c, k: reference(r, c, 1.0), "The power k is an argument."),
        (lambda r, c, k: reference(r, 1.0, k), "The residual is divided by c."),
        (lambda r, c, k: reference(r, c**0.5, k), "c is squared, like the residual."),
        (lambda r, c, k: 1 / reference(r, c, k), "The power is -k: large residuals count little."),
        (lambda r, c, k: r.norm(dim=1) * reference(r, c, k), "This is the pull, w r."),
        (lambda r, c, k: RobustKernel(c, k).weight(r**2), "A cell has one weight: sum over u, v."),
        (lambda r, c, k: RobustKernel(c, k).weight(r.norm(dim=1)), "r is squared, like c."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_prior_mask(student: Function) -> Verdict:
    """Check (depth, [(depth, T_this_other)], camera, stride, epsilon) -> M (h, w) bool."""
    camera = Camera(60.0, 60.0, 31.3, 22.6, 64, 48)

    def reference(depth: Tensor, others: list, *rest: Any, seen: int = 2, agree: int = 2) -> Tensor:
        grid, same = Grid.of(camera, rest[-2]), torch.ones(1, 1, 1).double()
        this = DepthView(depth, same, torch.eye(4).double())
        views = [DepthView(there, same, se3_inverse(T)) for there, T in others]
        corresponding, consistent = depth_consistency(grid, this, views, rest[-1], -2.0)
        return ((corresponding < seen) | (consistent >= agree)).double().view(grid.shape)

    def wall(T_this_other: Tensor) -> Tensor:
        """Return the depth of a wall, 3 m before this view, as another view sees it."""
        rays = camera.rays(camera.pixel_grid(1, torch.float64)) @ T_this_other[:3, :3].T
        return (3 - T_this_other[2, 3]) / rays[..., 2]

    def case(
        count: int, patched: float, what: str, seed: int = 2, stride: int = 4, most: float = 0.02
    ) -> Case:
        poses = se3_exp(0.08 * normals(seed, count, 6).clamp(-2, 2))
        poses[-1, 2, 3] = -0.5
        poses[0, :3, 3] = doubles(0.0117, 0.0233, 1) * 0.5  # its centre falls on a cell
        others = [(wall(T), T) for T in poses]
        depth = wall(torch.eye(4).double())
        depth[10:30, 8:30] *= patched
        for number, (seen, _) in enumerate(others[1:-1], start=1):
            seen[8 * number : 8 * number + 20, 30:50] *= 0.6  # in front of the wall, for one view
        others[-1][0][:20, 40:] = 0.3  # behind this view
        others[0][0][::2] = 0  # unknown
        return Case((depth, others, camera, stride, most), what)

    cases = [
        case(4, 0.7, "a region whose depth is 30 % too small"),
        case(4, 1.01, "a region whose depth is 1 % too large"),
        case(4, 1.0202, "a region whose depth is 2.02 % too large"),
        case(4, 0.0, "a region without depth"),
        case(1, 0.7, "a single other view"),
        *drawn(lambda seed: case(3, 1.035, "drawn views, an epsilon of 0.05", seed, 3, 0.05)),
    ]
    unknown = "Without a depth, M stays 1."
    back = "T_this_other takes points of the other view to this one, not back."
    known = "A depth of 0 is unknown in the other views, too."
    relative = "Divide the difference by the other's depth."
    mistakes = [
        (lambda *a: reference(*a[:-1], 0.02), "0.02 is one epsilon of many: use the argument."),
        (lambda *a: reference(*a[:-2], 4, a[-1]), "4 is one stride of many: use the argument."),
        (lambda *a: reference(*a, seen=0), "Where fewer than two views have a depth, M stays 1."),
        (lambda *a: 1 - reference(*a), "M is 1 where the prior counts, 0 where views contradict."),
        (lambda d, o, *a: reference(d, [(x, se3_inverse(T)) for x, T in o], *a), back),
        (lambda *a: reference(*a, agree=1), "Two views must agree, not one."),
        (lambda d, *a: reference(d, *a) * (d > 0)[:: a[-2], :: a[-2]], unknown),
        # Where all depths are near 3 m, an absolute error is a third of it, relatively.
        (lambda *a: reference(*a[:-1], a[-1] / 3), relative),
        # An error relative to the own depth, where that is the larger of the two.
        (lambda *a: reference(*a[:-1], a[-1] / (1 - a[-1])), relative),
        (lambda d, o, *a: reference(d, [(x.clamp_min(1e-9), T) for x, T in o], *a), known),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)
