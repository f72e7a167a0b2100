"""Right and wrong answers to the exercises of notebook 05."""

import numpy as np
import pytest
import torch

from minislam.checks import check_schur_step, check_target_jacobian
from tests.helpers import assert_variants


def hat(X):
    x, y, z = X.T
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).view(-1, 3, 3)


def jacobian(X, d, camera, scale=True, turn=-1.0):
    sliding = (d if scale else torch.ones_like(d))[:, None, None] * torch.eye(3).to(X)
    return camera.project_jacobian(X) @ torch.cat([sliding, turn * hat(X)], -1)


def in_coordinates(X, d, camera):
    rows = []
    for (x, y, z), q in zip(X.tolist(), d.tolist(), strict=True):
        a, b = x / z, y / z
        rows.append(
            [
                [camera.fx * f for f in (q / z, 0, -a * q / z, -a * b, 1 + a * a, -b)],
                [camera.fy * f for f in (0, q / z, -b * q / z, -1 - b * b, a * b, a)],
            ]
        )
    return np.array(rows)


@pytest.mark.ex05_1
def test_target_jacobian():
    right = {"matrices": jacobian, "coordinates": in_coordinates}
    wrong = {
        "no d": lambda *a: jacobian(*a, scale=False),
        "the other rotation": lambda *a: jacobian(*a, turn=1.0),
        "of the residual": lambda *a: -jacobian(*a),
        "rotation first": lambda *a: jacobian(*a).roll(3, -1),
        "d in the rotation": lambda X, d, c: torch.cat(
            [jacobian(X, d, c)[..., :3], d[:, None, None] * jacobian(X, d, c)[..., 3:]], -1
        ),
        "no rotation": lambda *a: jacobian(*a, turn=0.0),
        "of three points": lambda *a: jacobian(*a)[:3],
        "transposed": lambda *a: jacobian(*a).mT,
        "without the camera": lambda X, d, c: jacobian(X, d, c) / c.fx,
        "of X": lambda X, d, c: torch.cat([d[:, None, None] * torch.eye(3).to(X), -hat(X)], -1),
    }
    assert_variants(check_target_jacobian, right, wrong)


def step(H, E, C, g, s):
    xi = torch.linalg.solve(H - E / C @ E.T, g - E @ (s / C))
    return xi, (s - E.T @ xi) / C


def of_all(H, E, C, g, s):
    whole = torch.cat([torch.cat([H, E], 1), torch.cat([E.T, C.diag()], 1)])
    both = torch.linalg.solve(whole, torch.cat([g, s]))
    return [both[: len(g)], both[len(g) :]]


def with_numpy(H, E, C, g, s):
    H, E, C, g, s = (x.double().numpy() for x in (H, E, C, g, s))
    xi = np.linalg.inv(H - E @ np.diag(1 / C) @ E.T) @ (g - E @ (s / C))
    return xi, (s - E.T @ xi) / C


def poses_alone(H, E, C, g, s):
    xi = torch.linalg.solve(H, g)
    return xi, (s - E.T @ xi) / C


def old_right_side(H, E, C, g, s):
    xi = torch.linalg.solve(H - E / C @ E.T, g)
    return xi, (s - E.T @ xi) / C


def plus_on_the_right(H, E, C, g, s):
    xi = torch.linalg.solve(H - E / C @ E.T, g + E @ (s / C))
    return xi, (s - E.T @ xi) / C


def ahead(H, E, C, g, s):
    xi, _ = step(H, E, C, g, s)
    return xi, (s + E.T @ xi) / C


def added(H, E, C, g, s):
    xi = torch.linalg.solve(H + E / C @ E.T, g - E @ (s / C))
    return xi, (s - E.T @ xi) / C


def without_C(H, E, C, g, s):
    xi = torch.linalg.solve(H - E @ E.T, g - E @ s)
    return xi, (s - E.T @ xi) / C


@pytest.mark.ex05_2
def test_schur_step():
    right = {"torch": step, "everything at once": of_all, "numpy": with_numpy}
    wrong = {
        "poses alone": poses_alone,
        "old right-hand side": old_right_side,
        "added": added,
        "plus on the right": plus_on_the_right,
        "disparities ahead of the poses": ahead,
        "without C": without_C,
        "not substituted": lambda *a: (step(*a)[0], a[4] / a[2]),
        "delta first": lambda *a: step(*a)[::-1],
        "not divided": lambda H, E, C, g, s: (
            step(H, E, C, g, s)[0],
            s - E.T @ step(H, E, C, g, s)[0],
        ),
        "xi alone": lambda *a: step(*a)[0],
        "the other sign": lambda *a: tuple(-part for part in step(*a)),
    }
    assert_variants(check_schur_step, right, wrong)
    assert "not plus" in check_schur_step(plus_on_the_right).hint
    assert "with a minus" in check_schur_step(ahead).hint
    assert (
        "it returns 1 value, expected 2: xi, delta" in check_schur_step(wrong["xi alone"]).sentence
    )
