"""Exercises of notebook 05."""

from collections.abc import Callable

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
from minislam.geometry import Camera, se3_exp
from minislam.tracking.reprojection import reproject_with_jacobians, scaled_points


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
