"""Right and wrong answers to the exercises of notebook 07 that build."""

import math

import pytest
import torch

from minislam.checks import check_followed_pose, check_insertion, check_map_loss
from minislam.geometry import se3_exp, se3_inverse, transform_points
from minislam.mapping.pose_refinement import curvature
from minislam.splatting import render
from tests.helpers import assert_variants


def inserted(
    image, depth, weight, opacity, camera, T, cell, known=True, heavy=True, open=0.8, **how
):
    """Return the answer, with the mistake that is asked for."""
    wanted = (depth > 0) | (not known)
    wanted = wanted & ((weight > 0) | (not heavy)) & (opacity < open)
    middle = torch.zeros_like(wanted)
    first = 0 if how.get("corner") else cell // 2
    middle[first::cell, first::cell] = True
    row, column = (wanted & middle).nonzero().unbind(-1)
    z = depth[row, column]
    cx, cy = (0, 0) if how.get("no_centre") else (camera.cx, camera.cy)
    x, y = (column - cx) / camera.fx * z, (row - cy) / camera.fy * z
    points = torch.stack([x, y, z], -1).double()
    means = transform_points(T if how.get("forward") else se3_inverse(T), points)
    means = points if how.get("stay") else means
    size = 0.45 * cell / math.sqrt(camera.fx * camera.fy) * (1 if how.get("flat") else z)
    scale = torch.as_tensor(size).expand(len(z))[:, None]
    return torch.cat([means.to(z), scale.to(z), image[row, column].to(z)], -1)


def in_a_loop(image, depth, weight, opacity, camera, T, cell):
    rows = []
    for v in range(cell // 2, camera.height, cell):
        for u in range(cell // 2, camera.width, cell):
            if depth[v, u] > 0 and weight[v, u] > 0 and opacity[v, u] < 0.8:
                z = float(depth[v, u])
                ray = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0, 1 / z]
                mean = torch.linalg.inv(T) @ torch.tensor(ray).to(T) * z
                scale = 0.45 * cell * z / math.sqrt(camera.fx * camera.fy)
                rows.append([*mean[:3].tolist(), scale, *image[v, u].tolist()])
    return torch.tensor(rows)


@pytest.mark.ex07_3
def test_insertion():
    wrong = {
        "unknown depth too": {"known": False},
        "on dynamic objects too": {"heavy": False},
        "where the map is opaque too": {"open": 9.0},
        "corner of the cell": {"corner": True},
        "no principal point": {"no_centre": True},
        "pose forwards": {"forward": True},
        "camera's frame": {"stay": True},
        "one size": {"flat": True},
    }
    variants = {name: (lambda *a, how=how: inserted(*a, **how)) for name, how in wrong.items()}
    assert_variants(check_insertion, {"vectors": inserted, "loop": in_a_loop}, variants)


def of_parts(c, d, i, r, w, s, shares=(0.8, 0.2, 10.0), mask=True, own_mean=True):
    known = (r > 0) if mask else torch.ones_like(r)
    isotropic = (s - (s.mean(-1, keepdim=True) if own_mean else s.mean())).abs().mean()
    depth = (w * known * (d - r).abs()).mean()
    return (
        shares[0] * (w * (c - i).abs().mean(-1)).mean() + shares[1] * depth + shares[2] * isotropic
    )


def loss_in_a_loop(c, d, i, r, w, s):
    total = 0.0
    for v in range(d.shape[0]):
        for u in range(d.shape[1]):
            total = total + 0.8 * w[v, u] * sum((c[v, u] - i[v, u]).abs()) / 3
            total = total + 0.2 * w[v, u] * (d[v, u] - r[v, u]).abs() * float(r[v, u] > 0)
    spread = [(x - row.mean()).abs() for row in s for x in row]
    return total / d.numel() + 10 * sum(spread) / len(spread)


@pytest.mark.ex07_4
def test_map_loss():
    wrong = {
        "no weight": lambda c, d, i, r, w, s: of_parts(c, d, i, r, w.clone().fill_(1), s),
        "by the sum of weights": lambda c, d, i, r, w, s: of_parts(c, d, i, r, w / w.mean(), s),
        "no isotropic part": lambda *a: of_parts(*a, shares=(0.8, 0.2, 0.0)),
        "isotropic part once": lambda *a: of_parts(*a, shares=(0.8, 0.2, 1.0)),
        "a sum over RGB": lambda *a: of_parts(*a, shares=(2.4, 0.2, 10.0)),
        "shares exchanged": lambda *a: of_parts(*a, shares=(0.2, 0.8, 10.0)),
        "unknown depth too": lambda *a: of_parts(*a, mask=False),
        "one mean of all scales": lambda *a: of_parts(*a, own_mean=False),
        "squares": lambda c, d, i, r, w, s: of_parts(c**2, d, i**2, r, w, s),
        "a float": lambda *a: of_parts(*a).item(),
        "detached": lambda *a: of_parts(*a).detach(),
        "depth detached": lambda c, d, *rest: of_parts(c, d.detach(), *rest),
        "scales detached": lambda *a: of_parts(*a[:5], a[5].detach()),
        "a new tensor": lambda *a: torch.tensor(of_parts(*a).item(), requires_grad=True),
    }
    assert_variants(check_map_loss, {"mean": of_parts, "loop": loss_in_a_loop}, wrong)


def followed(gaussians, camera, T, image, weight, steps, rate=0.025, shrink=0.96, **how):
    """Descend with Adam, 60 steps; `sign`, `result`, `fold`: how it goes wrong, or another way."""
    twist, pose = torch.zeros(6, requires_grad=True), T
    optimizer = torch.optim.Adam([twist], lr=rate)
    for _ in range(60):
        view = render(gaussians, camera, pose, twist=twist)
        error = (view.color - image).abs().mean(-1) * view.opacity.detach()
        loss = how.get("sign", 1) * (error * (1 if how.get("equal") else weight)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        optimizer.param_groups[0]["lr"] *= shrink
        if how.get("fold"):
            pose = se3_exp(twist.detach().double()) @ pose
            twist.data.zero_()
    motion = se3_exp(twist.detach().double())
    results = {
        "left": motion @ pose,
        "right": pose @ motion,
        "inverse": se3_inverse(motion) @ pose,
        "motion": motion,
        "world": se3_inverse(motion @ pose),
        "start": T,
    }
    return results[how.get("result", "left")]


def newton(gaussians, camera, T, image, weight, steps, transparent=True, left=True):
    """Divide the gradient by the curvature."""
    for _ in range(steps):
        twist = torch.zeros(6, requires_grad=True)
        view = render(gaussians, camera, T, twist=twist)
        error = (view.color - image).abs().mean(-1)
        seen = view.opacity.detach() if transparent else 1
        (weight * seen * error).mean().backward()
        H = curvature(view, image, weight, camera)
        step = torch.linalg.solve(H + 0.1 * H.diagonal().diag(), twist.grad.double())
        T = se3_exp(-step) @ T if left else T @ se3_exp(-step)
    return T


@pytest.mark.slow
@pytest.mark.ex07_5
def test_followed_pose():
    right = {"Newton": newton, "Adam": followed, "folded": lambda *a: followed(*a, fold=True)}
    ways = ("right", "inverse", "motion", "world", "start")
    wrong = {way: (lambda *a, way=way: followed(*a, result=way)) for way in ways}
    wrong["uphill"] = lambda *a: followed(*a, sign=-1, rate=0.006)
    wrong["equal weights"] = lambda *a: followed(*a, equal=True)
    wrong["one step"] = lambda *a: newton(*a[:-1], 1)
    wrong["each step on the right"] = lambda *a: newton(*a, left=False)
    wrong["a twist"] = lambda *a: torch.zeros(6)
    wrong["holes of the map count"] = lambda *a: newton(*a, transparent=False)
    assert_variants(check_followed_pose, right, wrong, 0.6)
