"""Exercises of notebooks 06 and 06b."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
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
from minislam.priors.dense_flow import composed_flow, reverse_flow
from minislam.priors.grid_flow import grid_matches
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.frame_graph import flow_distances, proximity_pairs
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_selection import KEYFRAME_MATCHED_RATIO
from minislam.tracking.reprojection import relative_transforms, reproject
from minislam.tracking.safeguards import motion_memory


def check_flow_distance(
    student: Callable[[Tensor, Tensor, Tensor, Tensor, Camera, float], Tensor],
) -> Verdict:
    """Check (poses (2, 4, 4), disparities (2, N), rays, pixels, camera, beta) -> distance [px]."""
    pixels = CAMERA.pixel_grid(10, torch.float64).flatten(0, 1)
    disparities = 0.2 + 0.3 * normals(0, 2, len(pixels)).sigmoid()

    def reference(*arguments: Any) -> Tensor:
        return flow_distances(*arguments)[0, 1]

    def with_beta(change: Callable[[float], float]) -> Function:
        return lambda *arguments: reference(*arguments[:-1], change(arguments[-1]))

    def changed(length: Function, without_translation: bool = False) -> Function:
        """Return the distance with another mean of the flows (2, 2, N), both directions."""

        def distance(poses: Tensor, d: Tensor, rays: Tensor, pixels: Tensor, *rest: Any) -> Tensor:
            camera, beta = rest
            whole = relative_transforms(poses, [0, 1], [1, 0])
            part = torch.eye(4, dtype=poses.dtype).repeat(2, 1, 1)
            part[:, :3, 3] = whole[:, :3, 3]
            if without_translation:
                part = whole * (1 - part) + torch.eye(4, dtype=poses.dtype) * part
            flows = [reproject(T, d, rays, camera)[0] - pixels.T for T in (whole, part)]
            return beta * length(flows[0]) + (1 - beta) * length(flows[1])

        return distance

    def case(twist: list[float], beta: float, description: str) -> Case:
        poses = se3_exp(doubles([0.0] * 6, twist))
        rays = CAMERA.rays(pixels)
        return Case((poses, disparities, rays, pixels, CAMERA, beta), description)

    def draw(seed: int) -> Case:
        slide, turn = (0.1 * normals(seed, 2, 3).clamp(-2, 2)).tolist()
        return case([*slide, *[0.3 * angle for angle in turn]], 0.3, "another motion, beta = 0.3")

    cases = [
        case([0.3, -0.1, 0.0, 0.0, 0.0, 0.0], 0.75, "a camera that slides"),
        case([0.0, 0.0, 0.0, 0.02, 0.1, 0.0], 0.75, "a camera that turns"),
        case([0.3, 0.1, 0.2, 0.02, -0.05, 0.03], 0.75, "a camera that does both"),
    ]
    hints: Hints = [
        (with_beta(lambda beta: 1.0), "The flow without rotation has the weight 1 - beta."),
        (with_beta(lambda beta: 0.0), "This is the flow without rotation alone."),
        (with_beta(lambda beta: 1 - beta), "beta and 1 - beta are exchanged."),
        (with_beta(lambda beta: 0.75), "0.75 is one beta of many: use the argument."),
        (changed(lambda f: f[0].norm(dim=0).mean()), "One direction only: from 1 to 0 as well."),
        (changed(lambda f: f[1].norm(dim=0).mean()), "One direction only: from 0 to 1 as well."),
        (changed(lambda f: f.norm(dim=1).sum()), "Take the mean over the pixels, not the sum."),
        (changed(lambda f: f.mean(-1).norm(dim=1).mean()), "First the lengths, then their mean."),
        (changed(lambda f: f.norm(dim=1).median()), "The mean is asked for, not the median."),
        (changed(lambda f: f.abs().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (changed(lambda f: f.square().sum(1).mean()), "A length is the root of u^2 + v^2."),
        (
            changed(lambda f: f.norm(dim=1).mean(), True),
            "Leave out the rotation, not the translation.",
        ),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_suppressed(student: Callable[[int, int, int, int], Tensor]) -> Verdict:
    """Check (newer, older, K, suppression) -> (K, K), 1 where a pair a > b is suppressed."""

    def reference(newer: int, older: int, count: int, suppression: int) -> Tensor:
        suppressed = torch.zeros(count, count)
        for a in range(count):
            for b in range(a):
                # All other pairs are too far apart, so only this one can be returned.
                distances = torch.full((count, count), 2.0)
                distances[a, b] = 0.0
                pairs = proximity_pairs(
                    distances, [(newer, older)], range(count), 1.0, count, suppression
                )
                suppressed[a, b] = not pairs
        return suppressed

    def within(radius: int, count: int, newer: int, older: int, order: float) -> Tensor:
        a, b = torch.meshgrid(torch.arange(count), torch.arange(count), indexing="ij")
        offsets = torch.stack([a - newer, b - older]).double()
        return ((torch.linalg.vector_norm(offsets, order, 0) <= radius) & (a > b)).double()

    def radius_of(newer: int, older: int, suppression: int) -> int:
        return max(min(newer - older - 2, suppression), 0)

    def as_square(newer: int, older: int, count: int, suppression: int) -> Tensor:
        radius = radius_of(newer, older, suppression)
        return within(radius, count, newer, older, torch.inf)

    def unlimited(newer: int, older: int, count: int, suppression: int) -> Tensor:
        return within(suppression, count, newer, older, 1)

    def both_orders(newer: int, older: int, count: int, suppression: int) -> Tensor:
        answer = reference(newer, older, count, suppression)
        return answer + answer.T

    def of_radius(radius: Callable[[int, int], int]) -> Function:
        return lambda i, j, count, most: within(radius(i - j, most), count, i, j, 1)

    def draw(seed: int) -> Case:
        older, apart, most = 1 + seed % 4, 2 + seed % 5, 1 + seed % 3
        return Case((older + apart, older, 10, most), f"{apart} apart, suppression {most}")

    cases = [
        Case((8, 2, 11, 2), "a pair far apart in time"),
        Case((6, 3, 11, 2), "a pair three keyframes apart"),
        Case((5, 4, 11, 2), "two neighbours"),
    ]
    hints: Hints = [
        (as_square, "The neighbourhood is a diamond: |a| + |b|, not the larger of the two."),
        (unlimited, "Near the diagonal the radius shrinks: it is at most |i - j| - 2."),
        (both_orders, "Only pairs (newer, older) are wanted: a > b."),
        (of_radius(lambda n, most: min(n, most)), "At most |i - j| - 2: take 2 off."),
        (of_radius(lambda n, most: min(n - 2, most)), "A radius is at least 0: the pair itself."),
        (of_radius(lambda n, most: max(min(n - 2, most), 0) - 1), "Up to the radius: <=, not <."),
        (of_radius(lambda n, most: max(n - 2, 0)), "The radius is at most the suppression."),
        (of_radius(lambda n, most: 0), "Only the pair itself: its neighbours are left out, too."),
        (lambda *a: (1 - reference(*a)).tril(-1), "True stands for the pairs that are left out."),
    ]
    return check_function(student, reference, cases, 1e-9, hints, draw)


def check_keyframes(student: Callable[[list[np.ndarray], float, int], list[int]]) -> Verdict:
    """Check (gray images, largest mean flow [px], longest interval) -> frames to keep."""

    def choice(weighted: bool = True, restart: bool = True, matched: bool = True) -> Function:
        def run(images: list[np.ndarray], max_flow: float, interval: int) -> list[int]:
            kept = [0]
            none = np.zeros((*images[0].shape, 2), np.float32)
            cells = none[::8, ::8]
            flow, start = none, images[0]
            for n, image in enumerate(images[1:], 1):
                flow = composed_flow(start, image, flow)
                back = reverse_flow(start, image, flow)
                _, sure = grid_matches(flow, cells, back, cells[..., 0] + 1, 8)
                weight = sure if weighted else np.ones_like(sure)
                length = np.linalg.norm(flow[::8, ::8], axis=-1)
                mean = (weight * length).sum() / max(weight.sum(), 1e-9)
                unmatched = matched and sure.mean() < KEYFRAME_MATCHED_RATIO
                if mean > max_flow or unmatched or n - kept[-1] >= interval:
                    kept.append(n)
                    start, flow = (image, none) if restart else (start, flow)
            return kept

        return run

    noise = np.random.default_rng(0).integers(0, 256, (2, 30, 60), np.uint8)
    wide = [cv2.resize(part, (480, 240), interpolation=cv2.INTER_CUBIC) for part in noise]

    def shown(columns: list[float], blinking: bool = False) -> list[np.ndarray]:
        views = []
        for number, column in enumerate(columns):
            shift = np.array([[1, 0, -column], [0, 1, -60]])
            view = cv2.warpAffine(wide[0], shift, (160, 120))
            if blinking:  # a screen that shows another picture in each frame
                view[20:100, 30:110] = wide[1][20:100, 80 * (number % 4) :][:, :80]
            views.append(view)
        return views

    def draw(seed: int) -> Case:
        speed = 1.5 + 0.25 * (seed % 5)
        columns = [20.0 + speed * n for n in range(5)]
        return Case((shown(columns), 2.5 * speed, 20), f"{speed} px a frame")

    slide = [2.0 * n for n in range(9)]
    leap = shown(slide[:3] + [column + 150 for column in slide[3:5]])
    cases = [
        Case((shown(slide), 6.9, 20), "a camera that moves on by 2 px a frame"),
        Case((shown([0.2 * n for n in range(6)]), 20.0, 3), "a camera that hardly moves"),
        Case((leap, 500.0, 20), "a camera that leaps to another place"),
        Case((shown(slide[:6], blinking=True), 6.9, 20), "a screen that blinks"),
    ]
    hints: Hints = [
        (choice(weighted=False), "The mean is weighted by the confidence of each cell."),
        (choice(matched=False), "A frame of which too little is matched is kept as well."),
        (
            lambda a, b, c: choice()(a, b, 99),
            "A frame is kept at the latest `interval` frames after the last.",
        ),
        (choice(restart=False), "The flow starts anew, from the frame that was kept last."),
        (lambda *a: choice()(*a)[1:], "Frame 0 is the first that is kept."),
    ]
    return check_function(student, choice(), cases, 1e-9, hints, draw)


def check_motion_memory(
    student: Callable[[Grid, FlowMatches, Tensor, Tensor, Tensor, float], Tensor],
) -> Verdict:
    """Check (grid, matches, disparities, motion, weights, scale) -> weights of the next cells."""
    grid = Grid.of(CAMERA, 8)
    grid.rays = grid.rays.to(torch.get_default_dtype())

    def reference(grid: Grid, matches: FlowMatches, *rest: Any) -> Tensor:
        weight = motion_memory.update_motion_weight(grid, matches, *rest)
        return motion_memory.inherit_motion_weight(grid, matches, weight)

    def changed(constants: dict[str, float]) -> Function:
        def run(*arguments: Any) -> Tensor:
            known = {name: getattr(motion_memory, name) for name in constants}
            try:
                vars(motion_memory).update(constants)
                return reference(*arguments)
            finally:
                vars(motion_memory).update(known)

        return run

    def stays(*arguments: Any) -> Tensor:
        return motion_memory.update_motion_weight(*arguments)

    def zeros_left(grid: Grid, matches: FlowMatches, *rest: Any) -> Tensor:
        columns, rows = (matches.targets[0] / grid.stride).round().long()
        empty = torch.ones(grid.shape)
        for column, row, sure in zip(columns, rows, matches.confidences[0, 0], strict=True):
            if 0 <= column < grid.shape[1] and 0 <= row < grid.shape[0] and sure > 0.1:
                empty[row, column] = 0
        return reference(grid, matches, *rest) * (1 - empty.flatten())

    def case(twist: list[float], aside: float, sure: float, what: str, seed: int = 3) -> Case:
        drawn = normals(seed, 4, len(grid.rays)).erf().abs().to(grid.rays)  # in [0, 1)
        disparities, motion = 0.2 + 0.3 * drawn[0], se3_exp(torch.tensor(twist))
        flow, _ = reproject(motion[None], disparities[None], grid.rays, CAMERA)
        flow = flow + aside * (drawn[1] < 0.4) * torch.tensor([[1.0], [-0.5]])
        confidences = (drawn[2] < sure).to(flow).expand(1, 2, -1)
        matches = FlowMatches(flow, confidences, torch.ones(1))
        return Case((grid, matches, disparities, motion, drawn[3], 2.0), what)

    def draw(seed: int) -> Case:
        slide, turn = (0.1 * normals(seed, 2, 3).clamp(-2, 2)).tolist()
        return case([*slide, *[angle / 4 for angle in turn]], 6.0, 0.8, "a drawn motion", seed)

    cases = [
        case([0.0] * 6, 3.0, 1.0, "a camera that stands still"),
        case([0.5, 0.1, 0.0, 0.0, 0.02, 0.0], 5.0, 1.0, "a camera that moves"),
        case([0.4, 0.0, 0.3, 0.02, 0.1, 0.1], 12.0, 0.6, "cells that are not matched"),
    ]
    hints: Hints = [
        (changed({"LOSS_RATE": 0.1, "RECOVERY_RATE": 0.9}), "It falls fast and recovers slowly."),
        (changed({"RECOVERY_RATE": 0.9}), "The rate is 0.9 only where the weight falls."),
        (changed({"DEPTH_ERROR": 0.0}), "c_m^2 also holds a hundredth of the squared parallax."),
        (changed({"MIN_CONFIDENCE": -1.0}), "Cells with a confidence of at most 0.1 say nothing."),
        (stays, "These are the weights of the source cells: hand them on along the flow."),
        (zeros_left, "A cell to which nothing flows takes the weight of the nearest one."),
    ]
    return check_function(student, reference, cases, 1e-4, hints, draw)
