"""The checks of notebook 05: right answers pass, known mistakes are named."""

import pytest
import torch
from torch import Tensor

from minislam.checks import WRONG, check_schur_step, check_target_jacobian
from minislam.geometry import Camera
from tests.helpers import assert_graded

pytestmark = pytest.mark.slow


def jacobian_of_target(points: Tensor, disparities: Tensor, camera: Camera) -> Tensor:
    def seen(points: Tensor) -> Tensor:
        return camera.project(points)

    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        moved = disparities[:, None] * axis
        columns.append(torch.func.jvp(seen, (points,), (moved,))[1])
    for axis in torch.eye(3, dtype=torch.float64):
        moved = torch.linalg.cross(axis.expand_as(points), points)
        columns.append(torch.func.jvp(seen, (points,), (moved,))[1])
    return torch.stack(columns, -1)


def step_of_all(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    matrix = torch.cat([torch.cat([H, E], 1), torch.cat([E.T, C.diag()], 1)])
    return torch.linalg.solve(matrix, torch.cat([g, s])).split((len(g), len(s)))


def test_a_solution_passes_and_wrong_answers_do_not():
    assert_graded(check_target_jacobian, jacobian_of_target)
    assert_graded(check_schur_step, step_of_all)


def test_known_mistakes_of_bundle_adjustment_are_named():
    first_three = torch.tensor([1.0, 1, 1, -1, -1, -1], dtype=torch.float64)
    verdict = check_target_jacobian(lambda *a: first_three * jacobian_of_target(*a))
    assert "wrong way round" in verdict.sentence
    verdict = check_target_jacobian(lambda X, d, K: jacobian_of_target(X, torch.ones_like(d), K))
    assert "for any disparities" in verdict.sentence and "d rho" in verdict.sentence
    assert "residual" in check_target_jacobian(lambda *a: -jacobian_of_target(*a)).sentence

    def alone(H: Tensor, E: Tensor, C: Tensor, g: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        xi = torch.linalg.solve(H, g)
        return xi, (s - E.T @ xi) / C

    assert "subtract E C^-1 E^T" in check_schur_step(alone).sentence
    verdict = check_schur_step(lambda H, E, C, g, s: (step_of_all(H, E, C, g, s)[0], s / C))
    assert "follow the poses" in verdict.sentence
    assert check_schur_step(lambda *a: (a[3], None)).status == WRONG
