"""Exercises of notebooks 06 and 06b."""

from itertools import combinations
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.checks.cases import CAMERA, Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import se3_exp
from minislam.priors import grid_flow
from minislam.priors.dense_flow import composed_flow, reverse_flow, warp
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.frame_graph import flow_distances, proximity_pairs
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_selection import KEYFRAME_MATCHED_RATIO
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards import motion_memory
from minislam.tracking.safeguards.robust import RobustKernel


def any_twist(seed: int, turn: float) -> list[float]:
    """Return a drawn motion (rho, phi) of about 0.1 units and `turn` radians about each axis."""
    return (normals(seed, 6).clamp(-2, 2) * doubles(*[0.1] * 3, *[turn] * 3)).tolist()


def check_flow_distance(student: Function) -> Verdict:
    """Check (poses (2, 4, 4), disparities (2, N), rays, pixels, camera, eta) -> distance [px]."""
    pixels = CAMERA.pixel_grid(10, torch.float64).flatten(0, 1)
    disparities = 0.2 + 0.3 * normals(0, 2, len(pixels)).sigmoid()

    def reference(*arguments: Any) -> Tensor:
        return flow_distances(*arguments)[0, 1]

    def changed(length: Function, turned: bool = False) -> Function:
        """Return the distance with another mean of the flows (2, 2, N), both directions."""

        def distance(*a: Any) -> Tensor:
            poses, disparities, rays, pixels, camera, eta = a
            whole = relative_transforms(poses, [0, 1], [1, 0])
            part = torch.eye(4, dtype=poses.dtype).repeat(2, 1, 1)
            kept = (slice(None), slice(3), slice(3) if turned else 3)
            part[kept] = whole[kept]
            flows = [reproject(T, disparities, rays, camera)[0] - pixels.T for T in (whole, part)]
            return eta * length(flows[0]) + (1 - eta) * length(flows[1])

        return distance

    def case(twist: list[float], eta: float, description: str) -> Case:
        poses, rays = se3_exp(doubles([0.0] * 6, twist)), CAMERA.rays(pixels)
        return Case((poses, disparities, rays, pixels, CAMERA, eta), description)

    cases = [
        case([0.3, -0.1, 0.0, 0.0, 0.0, 0.0], 0.75, "a camera that slides"),
        case([0.0, 0.0, 0.0, 0.02, 0.1, 0.0], 0.75, "a camera that turns"),
        case([0.3, 0.1, 0.2, 0.02, -0.05, 0.03], 0.75, "a camera that does both"),
        *drawn(lambda seed: case(any_twist(seed, 0.03), 0.3, "another motion, eta = 0.3")),
    ]
    mistakes = [
        (lambda *a: reference(*a[:-1], 1.0), "The flow without rotation has the weight 1 - eta."),
        (lambda *a: reference(*a[:-1], 0.0), "This is the flow without rotation alone."),
        (lambda *a: reference(*a[:-1], 1 - a[-1]), "eta and 1 - eta are exchanged."),
        (lambda *a: reference(*a[:-1], 0.75), "0.75 is one eta of many: use the argument."),
        (changed(lambda f: f[0].norm(dim=0).mean()), "One direction only: from 1 to 0 as well."),
        (changed(lambda f: f[1].norm(dim=0).mean()), "One direction only: from 0 to 1 as well."),
        (changed(lambda f: f.norm(dim=1).sum()), "Take the mean over the pixels, not the sum."),
        (changed(lambda f: f.mean(-1).norm(dim=1).mean()), "First the lengths, then their mean."),
        (changed(lambda f: f.norm(dim=1).median()), "The mean is asked for, not the median."),
        (changed(lambda f: f.abs().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (changed(lambda f: f.square().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (changed(lambda f: f.norm(dim=1).mean(), True), "Without rotation, not translation."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_suppressed(student: Function) -> Verdict:
    """Check (newer, older, K, suppression) -> (K, K), 1 where a pair a > b is suppressed."""

    def reference(newer: int, older: int, count: int, suppression: int) -> Tensor:
        suppressed = torch.zeros(count, count)
        for a, b in combinations(reversed(range(count)), 2):
            # All other pairs are too far apart, so only this one can be returned.
            distances = torch.full((count, count), 2.0)
            distances[a, b] = 0.0
            chosen = [(newer, older)], range(count), 1.0, count, suppression
            suppressed[a, b] = not proximity_pairs(distances, *chosen)
        return suppressed

    def of_radius(radius: Function, norm: float = 1) -> Function:
        def within(newer: int, older: int, count: int, most: int) -> Tensor:
            a, b = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
            offsets = torch.stack([a - newer, b - older]).double()
            length = torch.linalg.vector_norm(offsets, norm, 0)
            return ((length <= radius(newer - older, most)) & (a > b)).double()

        return within

    def draw(seed: int) -> Case:
        older, apart, most = 1 + seed % 4, 2 + seed % 5, 1 + seed % 3
        return Case((older + apart, older, 11, most), f"{apart} apart, suppression {most}")

    cases = [
        Case((8, 2, 11, 2), "a pair far apart in time"),
        Case((9, 1, 11, 3), "a pair near the corner of the table"),
        Case((6, 3, 11, 2), "a pair three keyframes apart"),
        Case((5, 4, 11, 2), "two neighbours"),
        *drawn(draw),
    ]
    mistakes = [
        (of_radius(lambda n, most: max(min(n - 2, most), 0), torch.inf), "A diamond: |a| + |b|."),
        (of_radius(lambda n, most: most), "Near the diagonal the radius shrinks: |i - j| - 2."),
        (lambda *a: reference(*a) + reference(*a).T, "Only pairs (newer, older), a > b."),
        (of_radius(lambda n, most: min(n - 2, most)), "A radius is at least 0: the pair itself."),
        (of_radius(lambda n, most: max(min(n - 2, most), 0) - 1), "Up to the radius: <=, not <."),
        (of_radius(lambda n, most: max(n - 2, 0)), "The radius is at most the suppression."),
        (of_radius(lambda n, most: 0), "Only the pair itself: its neighbours are left out, too."),
        (lambda *a: (1 - reference(*a)).tril(-1), "True stands for the pairs that are left out."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_keyframes(student: Function) -> Verdict:
    """Check (gray images, largest mean flow [px], longest interval) -> frames to keep."""

    def choice(*clip: Any, flaw: str = "") -> list[int]:
        images, max_flow, interval = clip
        kept, none = [0], np.zeros((*images[0].shape, 2), np.float32)
        cells, flow, start = none[::8, ::8], none, images[0]
        for n, image in enumerate(images[1:], 1):
            flow = composed_flow(start, image, none if flaw == "cold" else flow)
            back = reverse_flow(start, image, flow)
            _, sure = grid_flow.grid_matches(flow, cells, back, cells[..., 0] + 1, 8)
            if flaw == "outside":
                round_trip = (flow + warp(back, flow))[::8, ::8]
                sure = np.exp(-0.5 * (round_trip**2).sum(-1) / 0.6**2)
            weight = np.ones_like(sure) if flaw == "equal" else sure
            length = np.linalg.norm(flow[::8, ::8], axis=-1)
            mean = (weight * length).sum() / max(weight.sum(), 1e-9)
            unmatched = flaw != "unmatched" and sure.mean() < KEYFRAME_MATCHED_RATIO
            if mean > max_flow or unmatched or n - kept[-1] >= interval:
                kept.append(n)
                start, flow = (start, flow) if flaw == "no restart" else (image, none)
        return kept

    noise = np.random.default_rng(0).integers(0, 256, (2, 30, 60), np.uint8)
    wide = [cv2.resize(part, (480, 240), interpolation=cv2.INTER_CUBIC) for part in noise]

    def shown(columns: list[float], blinking: bool = False) -> list[np.ndarray]:
        shifts = [np.array([[1, 0, -column], [0, 1, -60]]) for column in columns]
        views = [cv2.warpAffine(wide[0], shift, (160, 120)) for shift in shifts]
        for number, view in enumerate(views if blinking else []):  # a screen, each time another
            view[20:100, 30:110] = wide[1][20:100, 80 * (number % 4) :][:, :80]
        return views

    def draw(seed: int) -> Case:
        speed = 1.5 + 0.25 * (seed % 5)
        moving = shown([20.0 + speed * n for n in range(5)])
        return Case((moving, 2.5 * speed, 20), f"{speed} px a frame")

    sizes = 1 + 0.1 * np.arange(8)
    growth = [np.array([[s, 0, 80 - 180 * s], [0, s, 60 - 120 * s]]) for s in sizes]
    closer = [cv2.warpAffine(wide[0], zoom, (160, 120)) for zoom in growth]
    slide = [2.0 * n for n in range(9)]
    leap = shown(slide[:3] + [column + 150 for column in slide[3:5]])
    cases = [
        Case((shown(slide), 6.9, 20), "a camera that moves on by 2 px a frame"),
        Case((shown([0.2 * n for n in range(6)]), 20.0, 3), "a camera that hardly moves"),
        Case((leap, 500.0, 20), "a camera that leaps to another place"),
        Case((shown(slide[:6], blinking=True), 6.9, 20), "a screen that blinks"),
        Case(([*closer, leap[-1]], 500.0, 20), "a camera that comes closer, then leaps"),
        Case((closer[:3], 9.2, 20), "cells that leave the image"),
        Case((closer[:2], 4.857, 20), "a flow near the limit, 4.864 px at every eighth pixel"),
        Case((shown([0.0, 12.0, 24.0, *[36.0] * 4]), 30.0, 4), "a camera that stops"),
        *drawn(draw),
    ]
    one_way = patch.object(grid_flow, "sample", lambda flow, _: flow[::8, ::8])(choice)
    narrow = patch.object(grid_flow, "CONSISTENCY_SCALE", 0.6 / 2**0.5)(choice)
    mistakes = [
        ("outside", "The confidence is 0 where p + f(p) leaves the image."),
        ("equal", "The mean is weighted by the confidence of each cell."),
        ("unmatched", "A frame of which too little is matched is kept as well."),
        ("cold", "The flow starts from the flow to the frame before, not from zero."),
        ("no restart", "The flow starts anew, from the frame that was kept last."),
        (lambda a, b, _: choice(a, b, 99), "At the latest `interval` frames after the last one."),
        (lambda *a: choice(*a)[1:], "Frame 0 is the first that is kept."),
        (one_way, "The way back starts where the way forth ends: b(p + f(p))."),
        (narrow, "The exponent is a half of |e|^2 / 0.6^2."),
    ]
    return check_function(student, choice, cases, 1e-9, mistakes)


def check_bounded_loss(student: Function) -> Verdict:
    """Check (lengths r of residuals (N,) [px], scale c [px], k = 1 or 2) -> L_k (N,) [px^2]."""

    def reference(r: Tensor, c: float, k: int) -> Tensor:
        return RobustKernel(c, k).loss(r**2)

    cases = [
        Case((doubles(0, 0.5, 3, 40), 2.0, 1), "k = 1 and c = 2 px"),
        Case((doubles(0, 0.5, 3, 40), 2.0, 2), "k = 2 and c = 2 px"),
        *drawn(lambda seed: Case((normals(seed, 5).abs(), 0.5, 1 + seed % 2), "c = 0.5 px")),
    ]
    mistakes = [
        (lambda r, c, k: reference(r, c, 1), "With k = 2 the loss is bounded: L_2."),
        (lambda r, c, k: reference(r, c, 2), "With k = 1 the loss is a logarithm: L_1."),
        (lambda r, c, k: reference(r, c, k) / c**2, "The factor c^2 in front is missing."),
        (lambda r, c, k: r**2, "This is least squares: not yet robust."),
        (lambda r, c, k: RobustKernel(c, k).weight(r**2), "This is the weight, the loss's slope."),
        (lambda r, c, k: RobustKernel(c, k).loss(r * c), "r / c is squared."),
        (lambda r, c, k: reference(r, c, k) / 2, "This is half of the loss."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_motion_memory(student: Function) -> Verdict:
    """Check (grid, matches, disparities, motion, weights, scale) -> weights of the next cells."""
    grid = Grid.of(CAMERA, 8)
    grid.rays = grid.rays.to(torch.get_default_dtype())

    def reference(grid: Grid, matches: FlowMatches, *rest: Any) -> Tensor:
        weight = motion_memory.update_motion_weight(grid, matches, *rest)
        return motion_memory.inherit_motion_weight(grid, matches, weight)

    def case(twist: list[float], aside: float, sure: float, what: str, seed: int = 3) -> Case:
        random = normals(seed, 4, len(grid.rays)).erf().abs().to(grid.rays)  # in [0, 1)
        disparities, motion = 0.2 + 0.3 * random[0], se3_exp(torch.tensor(twist))
        flow, _ = reproject(motion[None], disparities[None], grid.rays, CAMERA)
        flow = flow + aside * (random[1] < 0.4) * torch.tensor([[1.0], [-0.5]])
        horizontal = torch.where(random[2] < sure, 0.3, 0.12)  # their means are 0.15 and 0.06
        confidences = torch.stack([horizontal, 0 * horizontal])[None].to(flow)
        matches = FlowMatches(flow, confidences, torch.ones(1))
        return Case((grid, matches, disparities, motion, random[3], 2.0), what)

    cases = [
        case([0.0] * 6, 3.0, 1.0, "a camera that stands still"),
        case([0.5, 0.1, 0.0, 0.0, 0.02, 0.0], 5.0, 1.0, "a camera that moves"),
        case([0.4, 0.0, 0.3, 0.02, 0.1, 0.1], 12.0, 0.6, "cells that are not matched"),
        case([0.1, 0.0, -2.5, 0.0, 0.0, 0.0], 5.0, 1.0, "cells behind the next camera"),
        *drawn(lambda seed: case(any_twist(seed, 0.025), 6.0, 0.8, "a drawn motion", seed)),
    ]
    behind = "A cell that is not valid, behind the next camera, keeps its weight."
    nearest = "A cell to which nothing flows takes the weight of the nearest one."
    changed: dict[str, dict[str, Any]] = {
        "It falls fast and recovers slowly.": {"LOSS_RATE": 0.1, "RECOVERY_RATE": 0.9},
        "The rate is 0.9 only where the weight falls.": {"RECOVERY_RATE": 0.9},
        "c_m^2 also holds a hundredth of the squared parallax.": {"DEPTH_ERROR": 0.0},
        "Cells with a confidence of at most 0.1 say nothing.": {"MIN_CONFIDENCE": -1.0},
        nearest: {"filled_from_nearest": lambda x, empty: x.masked_fill(empty, 0).flatten()},
        behind: {"reproject": lambda *a: (reproject(*a)[0], reproject(*a)[1] | True)},
    }
    handed_on = "These are the weights of the source cells: hand them on along the flow."
    mistakes = [
        *((patch.multiple(motion_memory, **c)(reference), hint) for hint, c in changed.items()),
        (motion_memory.update_motion_weight, handed_on),
    ]
    return check_function(student, reference, cases, 1e-4, mistakes)
