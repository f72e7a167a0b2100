"""Exercises of notebooks 05 and 05b."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import (
    CAMERA,
    Case,
    Function,
    Hints,
    Verdict,
    check_function,
    doubles,
    normals,
)
from minislam.geometry import Camera, se3_exp, se3_inverse
from minislam.tracking.bundle_adjustment import BundleProblem, BundleState
from minislam.tracking.disparity_prior import DepthView, depth_consistency
from minislam.tracking.grid import Grid
from minislam.tracking.reference import dense_normal_equations, moved
from minislam.tracking.reprojection import (
    relative_transforms,
    reproject,
    reproject_with_jacobians,
    scaled_points,
)


def check_target_jacobian(student: Callable[[Tensor, Tensor, Camera], Tensor]) -> Verdict:
    """Check (points X (N, 3), disparities (N,), camera) -> dp / d(rho, phi) (N, 2, 6) in px."""
    rays = CAMERA.rays(doubles([0.0, 0.0], [100.0, 52.0], [60.5, 10.25]))
    motion = se3_exp(doubles([0.1, -0.2, 0.3, 0.1, 0.2, -0.1]))

    def reference(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
        # A camera that stands still sees each cell where its ray points: X = ray of the cell.
        rays = points / points[:, 2:]
        still = torch.eye(4, dtype=points.dtype)[None]
        ratio = disparities / points[:, 2]
        return (
            reproject_with_jacobians(still, ratio[None], rays, camera).J_target[0].permute(2, 1, 0)
        )

    def signed(*signs: float) -> Function:
        return lambda *arguments: doubles(*signs) * reference(*arguments)

    def of_the_point(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
        return reference(points, torch.ones_like(disparities), camera)

    def rotation_first(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
        return reference(points, disparities, camera).roll(3, -1)

    def turned_with_depth(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
        J = reference(points, disparities, camera)
        return torch.cat([J[..., :3], disparities[:, None, None] * J[..., 3:]], -1)

    def case(disparities: Tensor, description: str, motion: Tensor = motion) -> Case:
        points = scaled_points(motion, disparities[None], rays)[0].T
        return Case((points, disparities, CAMERA), description)

    def draw(seed: int) -> Case:
        xi = 0.1 * normals(seed, 1, 6).clamp(-2, 2)
        return case(normals(seed, 3).abs(), "another motion", se3_exp(xi))

    cases = [
        case(doubles(1.0, 1.0, 1.0), "disparities of 1"),
        case(doubles(0.5, 0.25, 0.8), "any disparities"),
        case(doubles(0.0, 0.0, 0.0), "points at infinity"),
    ]
    hints: Hints = [
        (of_the_point, "X is d times the point, so it moves by d rho, not by rho."),
        (signed(1, 1, 1, -1, -1, -1), "The rotation is the wrong way round: it is -hat(X) phi."),
        (signed(-1, -1, -1, -1, -1, -1), "This is the derivative of the residual p~ - p."),
        (rotation_first, "The order is (rho, phi), translation first."),
        (turned_with_depth, "A rotation moves X by phi x X, without another d."),
        (signed(1, 1, 1, 0, 0, 0), "The rotation is missing: columns 3 to 5."),
        (signed(0, 0, 0, 1, 1, 1), "The translation is missing: columns 0 to 2."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_schur_step(
    student: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
) -> Verdict:
    """Check (H, E, diagonal of C, g, s) -> the steps of the poses and of the disparities."""

    def solved(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H - E / C @ E.T, g - E @ (s / C))
        return xi, (s - E.T @ xi) / C

    def poses_alone(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H, g)
        return xi, (s - E.T @ xi) / C

    def not_substituted(*arguments: Tensor) -> tuple[Tensor, Tensor]:
        return solved(*arguments)[0], arguments[4] / arguments[2]

    def added(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H + E / C @ E.T, g - E @ (s / C))
        return xi, (s - E.T @ xi) / C

    def unscaled(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H - E @ E.T, g - E @ s)
        return xi, (s - E.T @ xi) / C

    def undivided(*arguments: Tensor) -> tuple[Tensor, Tensor]:
        return solved(*arguments)[0], arguments[2] * solved(*arguments)[1]

    def old_gradient(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor):
        xi = torch.linalg.solve(H - E / C @ E.T, g)
        return xi, (s - E.T @ xi) / C

    def case(poses: int, cells: int, description: str, seed: int = 1) -> Case:
        rows = normals(seed, 4 * cells, 6 * poses + 2)
        J, r = rows[:, 2:], rows[:, 0]
        # Each cell has four residuals, which depend on no other cell.
        mine = torch.eye(cells, dtype=torch.float64).repeat_interleave(4, 0)
        Jd = mine * rows[:, 1:2]
        return Case((J.T @ J, J.T @ Jd, Jd.square().sum(0), J.T @ r, Jd.T @ r), description)

    def draw(seed: int) -> Case:
        return case(2, 8 + seed % 5, f"two poses and {8 + seed % 5} cells", seed)

    cases = [case(1, 5, "one pose and 5 cells"), case(3, 20, "three poses and 20 cells")]
    hints: Hints = [
        (poses_alone, "The disparities do not stand still: subtract E C^-1 E^T from H."),
        (old_gradient, "The right-hand side changes too: g - E C^-1 s."),
        (not_substituted, "The disparities must follow the poses: s - E^T xi."),
        (added, "E C^-1 E^T is subtracted from H, not added."),
        (unscaled, "C^-1 is missing between E and E^T, and between E and s."),
        (undivided, "The steps of the disparities are divided by C, one by one."),
        (lambda *a: solved(*a)[::-1], "The poses come first: xi, then delta."),
    ]
    return check_function(student, solved, cases, 1e-9, hints, draw, ("xi", "delta"))


def check_bundle_adjustment(
    student: Callable[[BundleProblem, BundleState, int, float], BundleState],
) -> Verdict:
    """Check (problem, state, steps, damping) -> the state after so many Gauss-Newton steps."""
    rays = CAMERA.rays(CAMERA.pixel_grid(25, torch.float64).flatten(0, 1))
    source, target = (1 - torch.eye(3)).nonzero().T

    def loop(
        sign: float = 1.0,
        left: bool = True,
        most: int = 99,
        damped: bool = True,
        changed: dict[str, Tensor] | None = None,
    ) -> Function:
        def run(problem: BundleProblem, state: BundleState, steps: int, damping: float) -> Any:
            problem = replace(problem, **(changed or {}))  # type: ignore[arg-type]
            for _ in range(min(steps, most)):
                equations = dense_normal_equations(problem, state)
                diagonal = (damping if damped else 1e-9) * torch.ones(len(equations.vector))
                step = torch.linalg.solve(equations.matrix + diagonal.diag(), equations.vector)
                after, before = moved(problem, state, sign * step), state.T_camera_world
                poses = after.T_camera_world
                poses = poses if left else before @ poses @ se3_inverse(before)
                state = BundleState(poses, after.disparities)
            return state.T_camera_world, state.disparities

        return run

    def answered(*arguments: Any) -> Any:
        state = student(*arguments)
        if not isinstance(state, BundleState):
            return state
        return state.T_camera_world, state.disparities

    def case(steps: int, held: int, weights: Tensor, description: str, seed: int = 1) -> Case:
        xi, start, noise, scatter = normals(seed, 4, 3, len(rays)).clamp(-2, 2)
        truth = BundleState(se3_exp(0.1 * xi[:, :6]), 0.5 + 0.1 * scatter.abs())
        motion = relative_transforms(truth.T_camera_world, source, target)
        flow = reproject(motion, truth.disparities[source], rays, CAMERA)[0] + noise[:2, :]
        none, keyframe = torch.zeros_like(scatter), torch.arange(3)
        edges = source, target, flow, weights
        free = keyframe >= held, keyframe >= 0
        problem = BundleProblem(CAMERA, rays, *edges, none, none, *free)
        nudged = se3_exp(0.02 * start[:, :6]) @ truth.T_camera_world
        return Case((problem, BundleState(nudged, none + 0.5), steps, 10.0), description)

    def draw(seed: int) -> Case:
        return case(1 + seed % 2, 1, normals(seed, 6, 2, len(rays)).abs(), "drawn weights", seed)

    ones = torch.ones(6, 2, len(rays)).double()
    hidden = ones * (torch.arange(len(rays)) > 1)
    some = normals(5, 6, 2, len(rays)).abs()
    cases = [
        case(1, 1, ones, "one step and weights of 1"),
        case(1, 2, some, "one step, two poses held, weights that differ"),
        case(1, 1, hidden, "two cells that no other view sees"),
        case(3, 2, some, "three steps"),
    ]
    hints: Hints = [
        (
            loop(changed={"weights": ones}),
            "Each residual counts with its weight: J^T W J and J^T W r.",
        ),
        (
            loop(changed={"free_poses": ones[0, 0, :3] > 0}),
            "A pose that is not free must not move.",
        ),
        (loop(sign=-1), "The step points uphill: with r = p~ - p it is added."),
        (loop(left=False), "The step stands on the left: exp(xi) T_camera_world."),
        (loop(damped=False), "Add the damping to the diagonals of H and of C."),
        (loop(most=1), "Repeat the step: each one linearises at the state the last one left."),
        (lambda *a: (loop()(*a)[0], a[1].disparities), "The disparities move as well: + delta."),
        (lambda *a: (a[1].T_camera_world, loop()(*a)[1]), "The poses move as well: exp(xi) T."),
    ]
    return check_function(answered, loop(), cases, 1e-7, hints, draw, ("poses", "disparities"))


def check_prior_mask(
    student: Callable[[Tensor, list[tuple[Tensor, Tensor]], Camera, int, float], Tensor],
) -> Verdict:
    """Check (depth, [(depth, T_this_other)], camera, stride, epsilon) -> M (h, w) bool."""
    camera, stride = Camera(60.0, 60.0, 31.3, 22.6, 64, 48), 4
    grid = Grid.of(camera, stride)

    def counted(depth: Tensor, others: list, error: float) -> tuple[Tensor, Tensor]:
        same = torch.ones(1, 1, 1).double()
        this = DepthView(depth, same, torch.eye(4).double())
        views = [DepthView(seen, same, se3_inverse(T)) for seen, T in others]
        counts = depth_consistency(grid, this, views, error, -2.0)
        return counts.corresponding.view(grid.shape), counts.consistent.view(grid.shape)

    def reference(depth: Tensor, others: list, *rest: Any) -> Tensor:
        corresponding, consistent = counted(depth, others, rest[-1])
        return (~((corresponding >= 2) & (consistent < 2))).double()

    def anywhere(depth: Tensor, others: list, *rest: Any) -> Tensor:
        return (counted(depth, others, rest[-1])[1] >= 2).double()

    def one_is_enough(depth: Tensor, others: list, *rest: Any) -> Tensor:
        corresponding, consistent = counted(depth, others, rest[-1])
        return (~((corresponding >= 2) & (consistent < 1))).double()

    def opposite(*arguments: Any) -> Tensor:
        return 1 - reference(*arguments)

    def backwards(depth: Tensor, others: list, *rest: Any) -> Tensor:
        return reference(depth, [(seen, se3_inverse(T)) for seen, T in others], *rest)

    def absolute(depth: Tensor, others: list, *rest: Any) -> Tensor:
        # Where all depths are near 3 m, an absolute error is a third of it, relatively.
        return reference(depth, others, rest[-1] / 3)

    def wall(T_this_other: Tensor) -> Tensor:
        """Return the depth of a wall, 3 m before this view, as another view sees it."""
        rays = camera.rays(camera.pixel_grid(1, torch.float64)) @ T_this_other[:3, :3].T
        return (3 - T_this_other[2, 3]) / rays[..., 2]

    def case(count: int, patched: float, description: str, seed: int = 2) -> Case:
        others = [(wall(T), T) for T in se3_exp(0.08 * normals(seed, count, 6).clamp(-2, 2))]
        depth = wall(torch.eye(4).double())
        depth[10:30, 8:30] *= patched
        for number, (seen, _) in enumerate(others):
            seen[8 * number : 8 * number + 20, 30:50] *= 0.6  # in front of the wall, for one view
        return Case((depth, others, camera, stride, 0.02), description)

    def draw(seed: int) -> Case:
        return case(3, 0.8, "three drawn views", seed)

    cases = [
        case(4, 0.7, "a region whose depth is 30 % too small"),
        case(4, 1.01, "a region whose depth is 1 % too large"),
        case(4, 0.0, "a region without depth"),
        case(1, 0.7, "a single other view"),
    ]
    hints: Hints = [
        (anywhere, "Where fewer than two views have a depth for the cell, M stays 1."),
        (opposite, "M is 1 where the prior counts, 0 where the views contradict it."),
        (backwards, "T_this_other takes points of the other view to this one, not back."),
        (one_is_enough, "Two views must agree, not one."),
        (absolute, "The difference is relative to the depth that arrives from the other view."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)
