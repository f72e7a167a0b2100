"""Right and wrong answers to the exercises of notebooks 02 and 03."""

import pytest
import torch

from minislam.checks import (
    check_conic_vjp,
    check_pixel_color,
    check_projected_covariance,
    check_twist_vjp,
)
from tests.helpers import assert_variants


def projected(S, mean, T, camera, low_pass=None, at_world=False, W=None):
    turn = T[:3, :3]
    J = camera.project_jacobian(mean if at_world else turn @ mean + T[:3, 3])
    W = turn if W is None else W
    return J @ W @ S @ W.T @ J.T + (0.3 * torch.eye(2).to(S) if low_pass is None else low_pass)


def by_columns(S, mean, T, camera):
    x, y, z = (T[:3, :3] @ mean + T[:3, 3]).tolist()
    J = torch.tensor(
        [[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]]
    )
    factor = torch.linalg.cholesky(S)
    V = J.double() @ T[:3, :3].double() @ factor.double()
    return (V @ V.T + 0.3 * torch.eye(2)).numpy()


@pytest.mark.ex02_1
def test_projected_covariance():
    right = {"matrices": projected, "a factor": by_columns}
    wrong = {
        "no low pass": lambda *a: projected(*a, low_pass=0),
        "0.3 everywhere": lambda *a: projected(*a, low_pass=0.3),
        "J at the world point": lambda *a: projected(*a, at_world=True),
        "not turned": lambda S, m, T, c: projected(S, m, T, c, W=torch.eye(3).to(S)),
        "turned back": lambda S, m, T, c: projected(S, m, T, c, W=T[:3, :3].T),
        "still in space": lambda S, m, T, c: T[:3, :3] @ S @ T[:3, :3].T,
        "a deviation": lambda *a: projected(*a).abs().sqrt(),
        "its inverse": lambda *a: torch.linalg.inv(projected(*a)),
    }
    assert_variants(check_projected_covariance, right, wrong)


def blended(alphas, colors, background, shaded=True, behind=True):
    color, light = torch.zeros(3).to(colors), 1.0
    for alpha, own in zip(alphas, colors, strict=True):
        color = color + (light if shaded else 1.0) * alpha * own
        light = light * (1 - alpha)
    return color + (light if behind else 1.0) * background


def from_the_back(alphas, colors, background):
    color = background.tolist()
    for alpha, own in reversed(list(zip(alphas.tolist(), colors.tolist(), strict=True))):
        color = [alpha * a + (1 - alpha) * b for a, b in zip(own, color, strict=True)]
    return color


def by_itself(alphas, colors, background):
    light = (1 - alphas).cumprod(0)
    end = light[-1] if len(light) else 1.0
    return (light * alphas) @ colors + end * background


def additive(alphas, colors, background):
    light = 1 - (alphas.cumsum(0) - alphas)
    return (light * alphas) @ colors + (1 - alphas.sum()) * background


@pytest.mark.ex02_2
def test_pixel_color():
    right = {"loop": blended, "from the back": from_the_back}
    wrong = {
        "no background": lambda a, c, b: blended(a, c, 0 * b),
        "all of the background": lambda *a: blended(*a, behind=False),
        "far first": lambda a, c, b: blended(a.flip(0), c.flip(0), b),
        "shades itself": by_itself,
        "no transmittance": lambda *a: blended(*a, shaded=False),
        "additive": additive,
        "opaque": lambda a, c, b: blended(a, c / a[:, None], b),
        "one number": lambda *a: blended(*a).mean(),
        "mixed with the mean": lambda a, c, b: 0.5 * blended(a, c, b) + 0.5 * c.sum(0),
    }
    assert_variants(check_pixel_color, right, wrong)


def conic_vjp(V, conics, v, twice_b=False, left=True):
    a, b, c = conics
    half = 1.0 if twice_b else 0.5
    Q = torch.stack([torch.stack([a, b]), torch.stack([b, c])])
    G = torch.stack([torch.stack([v[0], half * v[1]]), torch.stack([half * v[1], v[2]])])
    G = torch.einsum("ijn,jkn->ikn", Q, G) if left else G
    return -2 * torch.einsum("ikn,kln,lmn->imn", G, Q, V)


def conic_by_autograd(V, conics, v):
    V = V.detach().requires_grad_()
    M = torch.einsum("ikn,jkn->nij", V, V) + 0.3 * torch.eye(2).to(V)
    Q = torch.linalg.inv(M)
    loss = (v * torch.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]])).sum()
    return torch.autograd.grad(loss, V)[0]


def conic_one_by_one(V, conics, v):
    return torch.stack(
        [conic_vjp(V[..., [n]], conics[:, [n]], v[:, [n]])[..., 0] for n in range(V.shape[2])], -1
    )


def conic_upper_triangle(V, conics, v):
    a, b, c = conics
    Q = torch.stack([torch.stack([a, b]), torch.stack([b, c])])
    G = torch.stack([torch.stack([v[0], v[1]]), torch.stack([0 * v[1], v[2]])])
    return -2 * torch.einsum("ijn,jkn,kln,lmn->imn", Q, G, Q, V)


@pytest.mark.ex03_1
def test_conic_vjp():
    right = {"autograd": conic_by_autograd, "loop": conic_one_by_one}
    wrong = {
        "sign": lambda *a: -conic_vjp(*a),
        "factor 2": lambda *a: 0.5 * conic_vjp(*a),
        "b twice": lambda *a: conic_vjp(*a, twice_b=True),
        "one Q": lambda *a: conic_vjp(*a, left=False),
        "sum over N": lambda *a: conic_vjp(*a).sum(-1, keepdim=True).expand_as(a[0]),
        "the first for all": lambda *a: conic_vjp(*a)[..., :1].expand_as(a[0]),
        "mean over N": lambda *a: conic_vjp(*a) / a[0].shape[-1],
        "not symmetric": conic_upper_triangle,
        "of M": lambda V, Q, v: -conic_vjp(V, Q, v).transpose(0, 1),
    }
    assert_variants(check_conic_vjp, right, wrong)


def twist_vjp(x, B, v_x, v_B, dim=0):
    turn = torch.linalg.cross(x, v_x, dim=dim).sum(1)
    return torch.cat([v_x.sum(1), turn + torch.linalg.cross(B, v_B, dim=dim).sum((1, 2))])


def twist_by_autograd(x, B, v_x, v_B):
    xi = torch.zeros(6).to(x).requires_grad_()
    rho, phi = xi[:3], xi[3:]
    moved = x + rho[:, None] + torch.linalg.cross(phi[:, None].expand_as(x), x, dim=0)
    turned = B + torch.linalg.cross(phi[:, None, None].expand_as(B), B, dim=0)
    return torch.autograd.grad((v_x * moved).sum() + (v_B * turned).sum(), xi)[0]


def twist_by_loop(x, B, v_x, v_B):
    total = [0.0] * 6
    pairs = [(x, v_x, True)] + [(B[:, k], v_B[:, k], False) for k in range(3)]
    for vectors, gradients, slides in pairs:
        for p, g in zip(vectors.T.tolist(), gradients.T.tolist(), strict=True):
            turn = p[1] * g[2] - p[2] * g[1], p[2] * g[0] - p[0] * g[2], p[0] * g[1] - p[1] * g[0]
            parts = [*(g if slides else (0, 0, 0)), *turn]
            total = [a + b for a, b in zip(total, parts, strict=True)]
    return total


@pytest.mark.ex03_2
def test_twist_vjp():
    right = {"autograd": twist_by_autograd, "loop": twist_by_loop}
    signs = torch.tensor([1.0, 1, 1, -1, -1, -1])
    wrong = {
        "means only": lambda x, B, v, w: twist_vjp(x, B, v, 0 * w),
        "factors only": lambda x, B, v, w: twist_vjp(0 * x, B, v, w),
        "cross product swapped": lambda *a: signs.to(a[0]) * twist_vjp(*a),
        "rotation first": lambda *a: twist_vjp(*a).roll(3),
        "mean": lambda *a: twist_vjp(*a) / a[0].shape[1],
        "factors slide": lambda x, B, v, w: (
            twist_vjp(x, B, v, w) + torch.cat([w.sum((1, 2)), 0 * v.sum(1)])
        ),
        "no sum": lambda x, B, v, w: torch.cat([v, torch.linalg.cross(x, v, dim=0)]),
        "sign": lambda *a: -twist_vjp(*a),
        "inner product": lambda x, B, v, w: torch.cat([v.sum(1), (x * v).sum(1)]),
    }
    assert_variants(check_twist_vjp, right, wrong)
