"""Right and wrong answers to the exercises of notebook 06."""

import numpy as np
import pytest
import torch

from minislam.checks import check_flow_distance, check_suppressed
from minislam.geometry import se3_inverse, transform_points
from minislam.tracking.reprojection import relative_transforms, reproject
from tests.helpers import assert_variants


def both_flows(poses, disparities, rays, pixels, camera, change=lambda T: T):
    flows = []
    for source, target in ((0, 1), (1, 0)):
        T = poses[target] @ se3_inverse(poses[source])
        slide = torch.eye(4).to(T)
        slide[:3, 3] = T[:3, 3]
        points = rays / disparities[source][:, None]
        both = [camera.project(transform_points(M, points)) - pixels for M in (T, change(slide))]
        flows.append(torch.stack(both))
    return torch.stack(flows)  # (direction, with and without rotation, N, 2)


def distance(*arguments, length=lambda flows: flows.norm(dim=-1).mean(-1), directions=(0, 1)):
    *view, beta = arguments
    whole, slide = length(both_flows(*view)).unbind(1)
    lengths = beta * whole + (1 - beta) * slide
    return float(lengths[list(directions)].mean())  # a plain number


def with_the_packages_reprojection(poses, disparities, rays, pixels, camera, beta):
    T = relative_transforms(poses, [0, 1], [1, 0])
    slide = torch.eye(4).to(T).repeat(2, 1, 1)
    slide[:, :3, 3] = T[:, :3, 3]
    flows = [reproject(M, disparities, rays, camera)[0] - pixels.T for M in (T, slide)]
    return sum(w * f.norm(dim=1).mean() for w, f in zip((beta, 1 - beta), flows, strict=True))


def turn_alone(poses, disparities, rays, pixels, camera, beta):
    whole = both_flows(poses, disparities, rays, pixels, camera)[:, 0].norm(dim=-1).mean()
    still = poses.clone()
    still[:, :3, 3] = 0
    turned = both_flows(still, disparities, rays, pixels, camera)[:, 0].norm(dim=-1).mean()
    return beta * whole + (1 - beta) * turned


@pytest.mark.ex06_1
def test_flow_distance():
    right = {"plain number": distance, "reproject": with_the_packages_reprojection}
    wrong = {
        "without beta": lambda *a: distance(*a[:-1], 1.0),
        "no rotation": lambda *a: distance(*a[:-1], 0.0),
        "exchanged": lambda *a: distance(*a[:-1], 1 - a[-1]),
        "one direction": lambda *a: distance(*a, directions=(0,)),
        "the other direction": lambda *a: distance(*a, directions=(1,)),
        "no translation": turn_alone,
        "of the mean flow": lambda *a: distance(*a, length=lambda f: f.mean(-2).norm(dim=-1)),
        "median": lambda *a: distance(*a, length=lambda f: f.norm(dim=-1).median(-1).values),
        "sums of coordinates": lambda *a: distance(*a, length=lambda f: f.abs().sum(-1).mean(-1)),
        "squares": lambda *a: distance(*a, length=lambda f: f.square().sum(-1).mean(-1)),
        "both directions added": lambda *a: 2 * distance(*a),
        "0.75": lambda *a: distance(*a[:-1], 0.75),
    }
    assert_variants(check_flow_distance, right, wrong)


def suppressed(newer, older, count, suppression, radius=None, norm=1):
    limit = max(min(newer - older - 2, suppression), 0) if radius is None else radius
    offsets = [(a - newer, b - older, a, b) for a in range(count) for b in range(count)]
    near = [a > b and np.linalg.norm((i, j), norm) <= limit + 1e-9 for i, j, a, b in offsets]
    return np.array(near).reshape(count, count)


def as_lists(newer, older, count, suppression):
    return suppressed(newer, older, count, suppression).astype(int).tolist()


def inner(newer, older, count, suppression):
    """Return the same, but nothing where the diamond goes beyond the table."""
    chosen = suppressed(newer, older, count, suppression)
    radius = max(min(newer - older - 2, suppression), 0)
    return chosen & (radius <= min(older, count - 1 - newer))


@pytest.mark.ex06_2
def test_suppressed():
    right = {"numpy": suppressed, "lists of 0 and 1": as_lists}
    wrong = {
        "a square": lambda *a: suppressed(*a, norm=np.inf),
        "a disc": lambda i, j, n, s: suppressed(i, j, n, 2 * s, norm=2),
        "both orders": lambda *a: suppressed(*a) | suppressed(*a).T,
        "always the whole radius": lambda i, j, n, s: suppressed(i, j, n, s, s),
        "no 2": lambda i, j, n, s: suppressed(i, j, n, s, min(i - j, s)),
        "no limit": lambda i, j, n, s: suppressed(i, j, n, s, max(i - j - 2, 0)),
        "no 0": lambda i, j, n, s: suppressed(i, j, n, s, min(i - j - 2, s)),
        "less than": lambda i, j, n, s: suppressed(i, j, n, s, max(min(i - j - 2, s), 0) - 1),
        "at most 2": lambda i, j, n, s: suppressed(i, j, n, min(s, 2)),
        "not at the border": inner,
        "the pair alone": lambda i, j, n, s: suppressed(i, j, n, s, 0),
        "kept ones": lambda i, j, n, s: np.tril(~suppressed(i, j, n, s), -1),
        "transposed": lambda *a: suppressed(*a).T,
    }
    assert_variants(check_suppressed, right, wrong)
