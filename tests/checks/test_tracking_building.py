"""Right and wrong answers to the exercises that build: keyframes, and the memory of motion."""

import cv2
import numpy as np
import pytest
import torch

from minislam.checks import check_bounded_loss, check_keyframes, check_motion_memory
from minislam.priors import dense_flow
from minislam.tracking.pose_from_flow import filled_from_nearest
from minislam.tracking.reprojection import reproject
from tests.helpers import assert_variants


def kept(
    images, max_flow, interval,
    weighted=True, restart=True, matched=0.2, forced=True, stride=8, by_remap=False,
    by_number=False, warped=True, half=0.5, masked=True, zero=True, warm=True, first=0,
):  # fmt: skip
    height, width = images[0].shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    chosen, start, flow = [0], images[0], np.zeros((height, width, 2), np.float32)
    for n, image in enumerate(images[1:], 1):
        flow = dense_flow.composed_flow(start, image, flow if warm else np.zeros_like(flow))
        back = dense_flow.reverse_flow(start, image, flow)
        to_u, to_v = (u + flow[..., 0]).astype(np.float32), (v + flow[..., 1]).astype(np.float32)
        if not warped:
            home = back
        elif by_remap:
            home = cv2.remap(back, to_u, to_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        else:
            home = dense_flow.warp(back, flow)
        sure = np.exp(-half * ((flow + home) ** 2).sum(-1) / 0.36)
        if masked:
            sure *= (to_u >= 0) & (to_u <= width - 1) & (to_v >= 0) & (to_v <= height - 1)
        sure, length = sure[first::stride, first::stride], np.hypot(*np.moveaxis(flow, -1, 0))
        length = length[first::stride, first::stride]
        mean = np.average(length, weights=sure if weighted else None)
        late = n % interval == 0 if by_number else n - chosen[-1] >= interval
        if mean > max_flow or sure.mean() < matched or (forced and late):
            chosen.append(n)
            if restart:
                start, flow = image, np.zeros_like(flow) if zero else flow
    return chosen


@pytest.mark.slow
@pytest.mark.ex06_3
def test_keyframes():
    right = {
        "warp": kept,
        "remap, an array": lambda *a: np.array(kept(*a, by_remap=True)),
    }
    wrong = {
        "not weighted": lambda *a: kept(*a, weighted=False),
        "never starts anew": lambda *a: kept(*a, restart=False),
        "the old flow from a new frame": lambda *a: kept(*a, zero=False),
        "matched or not": lambda *a: kept(*a, matched=-1),
        "never forced": lambda *a: kept(*a, forced=False),
        "every so many frames": lambda *a: kept(*a, by_number=True),
        "without the first": lambda *a: kept(*a)[1:],
        "every frame": lambda *a: list(range(len(a[0]))),
        "back flow not warped": lambda *a: kept(*a, warped=False),
        "no half in the exponent": lambda *a: kept(*a, half=1.0),
        "twice the matched ratio": lambda *a: kept(*a, matched=0.4),
        "every pixel": lambda *a: kept(*a, stride=1),
        "the middles of the cells": lambda *a: kept(*a, first=4),
        "also outside of the image": lambda *a: kept(*a, masked=False),
    }
    assert_variants(check_keyframes, right, wrong)
    assert "not from zero" in check_keyframes(lambda *a: kept(*a, warm=False)).hint


def remembered(
    grid, matches, disparities, motion, weight, scale,
    fall=0.9, rise=0.1, parallax_part=0.01, confident=0.1, hand_on=True, fill=True, smallest=True,
    behind=False, confidence_of=lambda both: both.mean(0),
):  # fmt: skip
    T = motion[None].to(disparities)
    seen, valid = reproject(T, disparities[None], grid.rays, grid.camera)
    turned, _ = reproject(T, 0 * disparities[None], grid.rays, grid.camera)
    squared = (seen - matches.targets)[0].square().sum(0)
    parallax = (seen - turned)[0].square().sum(0)
    agreement = (1 + squared / (scale**2 + parallax_part * parallax)) ** -2
    matched = confidence_of(matches.confidences[0]) > confident
    rate = torch.where(agreement < weight, fall, rise)
    updated = matched & (valid[0] | behind)
    moved = torch.where(updated, (1 - rate) * weight + rate * agreement, weight)
    if not hand_on:
        return moved
    height, width = grid.shape
    inherited = torch.full(grid.shape, torch.inf, dtype=weight.dtype)
    columns, rows = (matches.targets[0] / grid.stride).round().long()
    for n in matched.nonzero().flatten().tolist():
        u, v = int(columns[n]), int(rows[n])
        if 0 <= u < width and 0 <= v < height:
            inherited[v, u] = min(inherited[v, u], moved[n]) if smallest else moved[n]
    empty = inherited.isinf()
    if not fill:
        return torch.where(empty, 0, inherited).flatten()
    return filled_from_nearest(inherited, empty)


def in_one_piece(grid, matches, disparities, motion, weight, scale):
    """Return the same, handed on by one scattered minimum."""
    updated = remembered(grid, matches, disparities, motion, weight, scale, hand_on=False)
    column, row = (matches.targets[0] / grid.stride).round().long()
    height, width = grid.shape
    arrives = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    arrives &= matches.confidences[0].mean(0) > 0.1
    inherited = torch.full((height * width,), torch.inf, dtype=weight.dtype)
    inherited.scatter_reduce_(0, (row * width + column)[arrives], updated[arrives], "amin")
    inherited = inherited.view(height, width)
    return filled_from_nearest(inherited, inherited.isinf()).numpy()


@pytest.mark.ex06b_2
def test_motion_memory():
    right = {"loop": remembered, "scatter, numpy": in_one_piece}
    wrong = {
        "rates exchanged": lambda *a: remembered(*a, fall=0.1, rise=0.9),
        "one rate": lambda *a: remembered(*a, rise=0.9),
        "no parallax": lambda *a: remembered(*a, parallax_part=0),
        "all cells": lambda *a: remembered(*a, confident=-1),
        "another threshold": lambda *a: remembered(*a, confident=0.5),
        "the larger confidence": lambda *a: remembered(*a, confidence_of=lambda c: c.amax(0)),
        "the confidence of v": lambda *a: remembered(*a, confidence_of=lambda c: c[1]),
        "not handed on": lambda *a: remembered(*a, hand_on=False),
        "holes": lambda *a: remembered(*a, fill=False),
        "last instead of smallest": lambda *a: remembered(*a, smallest=False),
        "falls only": lambda *a: remembered(*a, rise=0.0),
        "behind the camera": lambda *a: remembered(*a, behind=True),
    }
    assert_variants(check_motion_memory, right, wrong)


def bounded(r, c, p, factor=None):
    factor = c**2 if factor is None else factor
    return factor * (torch.log(1 + (r / c) ** 2) if p == 1 else r**2 / (r**2 + c**2))


@pytest.mark.ex06b_1
def test_bounded_loss():
    right = {"torch": bounded, "a list": lambda r, c, p: [float(bounded(x, c, p)) for x in r]}
    wrong = {
        "always Cauchy": lambda r, c, p: bounded(r, c, 1),
        "always Geman-McClure": lambda r, c, p: bounded(r, c, 2),
        "no c^2": lambda r, c, p: bounded(r, c, p, 1),
        "c once": lambda r, c, p: bounded(r, c, p, c),
        "least squares": lambda r, c, p: r**2,
        "weight": lambda r, c, p: (1 + r**2 / c**2) ** -p,
        "not squared": lambda r, c, p: bounded(r.sqrt(), c**0.5, p, c**2),
        "half": lambda r, c, p: bounded(r, c, p) / 2,
    }
    assert_variants(check_bounded_loss, right, wrong)
