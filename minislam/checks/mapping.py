"""Exercises of notebook 07."""

from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from minislam.checks.cases import CAMERA, Case, any_pose, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points
from minislam.mapping import pose_refinement
from minislam.mapping.config import InsertionConfig, PoseRefinementConfig
from minislam.mapping.deformation import deform_rigidly
from minislam.mapping.insertion import EXPLAINED_OPACITY, gaussians_at_pixels
from minislam.mapping.losses import color_loss, isotropic_loss
from minislam.mapping.window import sampling_probabilities
from minislam.splatting import GaussianMap, render
from minislam.uncertainty.losses import depth_loss


def check_sampling(student: Function) -> Verdict:
    """Check (number of keyframes N, window, its probability) -> that of each keyframe (N,)."""
    right = sampling_probabilities

    def shared(count: int, window: list[int], inside: float, outside: float) -> Tensor:
        probabilities = torch.full((count,), outside, dtype=torch.float64)
        probabilities[window] = inside
        return probabilities

    def uniform(count: int, *rest: Any) -> Tensor:
        return torch.full((count,), 1 / count, dtype=torch.float64)

    def unguarded(n: int, window: list[int], of_all: float) -> Tensor:
        return shared(n, window, of_all / len(window), (1 - of_all) / max(n - len(window), 1))

    def draw(seed: int) -> Case:
        count, of_all = 20 + seed % 7, (0.3, 0.6, 0.8)[seed % 3]
        window = normals(seed, count).argsort()[: 4 + seed % 2].tolist()
        return Case((count, window, of_all), f"the window {window} of {count}, {of_all}")

    cases = [
        Case((30, list(range(29, 19, -1)), 0.5), "30 keyframes, 10 of them in the window"),
        Case((13, list(range(12, 2, -1)), 0.5), "13 keyframes, 10 of them in the window"),
        Case((4, [3, 2, 1, 0], 0.5), "a window that holds all keyframes"),
        Case((20, [19, 18, 17, 5, 2], 0.3), "probability 0.3"),
        Case((20, [19, 18, 17, 16, 15, 14, 13, 12, 11, 10, 3, 2], 0.7), "probability 0.7"),
        *drawn(draw),
    ]
    at_half = "Compare the window's part of all keyframes with its probability."
    mistakes = [
        (unguarded, "While the window is most of the map, all keyframes are equally likely."),
        (lambda n, w, s: (uniform if 2 * len(w) > n else unguarded)(n, w, s), at_half),
        (uniform, "The window should get its probability, however many others there are."),
        (lambda n, w, s: shared(n, w, 1 / len(w), 0), "The others: the map would forget them."),
        (lambda n, w, s: shared(n, w, s, 1 - s), "The probability is that of the whole window."),
        (lambda n, w, s: unguarded(n, w, 1 - s), "It belongs to the window."),
        (lambda n, w, s: right(n, w, 0.5), "One half is one probability of many."),
        (lambda n, w, s: right(n, [*range(n)][-len(w) :], s), "Not the newest, but the window."),
    ]
    return check_function(student, right, cases, 1e-6, mistakes)


def check_deformed_means(student: Function) -> Verdict:
    """Check (means (N, 3), anchor_rows (N,), T_old, T_new (K, 4, 4)) -> moved means (N, 3).

    The poses are T_camera_world; each mean follows the keyframe of its row.
    """

    def reference(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
        zeros = torch.zeros_like(means)
        quats = means.new_tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
        gaussians = GaussianMap(means, quats, zeros, zeros[:, 0], zeros, rows)
        return deform_rigidly(gaussians, rows, old, new).means

    def moved(motion: Tensor, means: Tensor, rows: Tensor) -> Tensor:
        return transform_points(motion[rows], means[:, None])[:, 0]

    def translation(means: Tensor, rows: Tensor, old: Tensor, new: Tensor) -> Tensor:
        return (se3_inverse(new) @ old)[rows, :3, 3]

    def case(rows: Tensor, description: str, seed: int = 0) -> Case:
        poses = se3_exp(0.3 * normals(seed, 2, 3, 6))
        return Case((normals(seed, len(rows), 3), rows, *poses), description)

    cases = [
        case(torch.tensor([0] * 5), "a map of one keyframe"),
        case(torch.tensor([0, 1, 1, 0, 1]), "two keyframes that move apart"),
        *drawn(lambda seed: case(normals(seed, 6).argsort() % 3, "three keyframes", seed)),
    ]
    mistakes = [
        (lambda x, r, a, b: moved(se3_inverse(a) @ b, x, r), "The old pose comes first."),
        (lambda x, r, a, b: moved(b @ se3_inverse(a), x, r), "This moves points of a camera."),
        (lambda x, r, a, b: reference(x, 0 * r, a, b), "All follow the first keyframe."),
        (lambda x, r, a, b: x, "The means have not moved."),
        (lambda x, r, a, b: moved(a, x, r), "In the camera now: the new pose takes them back."),
        (lambda *a: reference(*a) - translation(*a), "The translation is missing."),
        (lambda *a: a[0] + translation(*a), "The rotation is missing."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_insertion(student: Function) -> Verdict:
    """Check (image, depth, weight, opacity, camera, T_camera_world, cell) -> new Gaussians (n, 7).

    A row is mean, scale, colour: of the middle pixel of each cell, row by row, where the depth is
    known, the weight positive and the map transparent.
    """

    def reference(*a: Any, flaw: str = "") -> Tensor:
        image, depth, weight, opacity, camera, T, cell = a
        known = (depth > 0) | (flaw == "unknown")
        allowed = known & (weight > 0) & (opacity < EXPLAINED_OPACITY)
        middle = torch.zeros_like(allowed)
        middle[cell // 2 :: cell, cell // 2 :: cell] = True
        pixels = (allowed & middle).nonzero().flip(-1)
        view = torch.full_like(allowed, cell, dtype=torch.int64), image, depth, camera, T
        new = gaussians_at_pixels(pixels, *view, 0, InsertionConfig())
        far = transform_points(T, new.means)[:, 2:] if flaw == "one size" else 1
        return torch.cat([new.means, new.scales[:, :1] / far, new.colors], -1)

    shape = CAMERA.height, CAMERA.width

    def seen(seed: int) -> tuple[Tensor, ...]:
        """Return image, depth with holes, static weight with a dynamic object, and opacity."""
        source = torch.Generator().manual_seed(seed)
        values = torch.rand(7, *shape, generator=source, dtype=torch.float64)
        values[3, 20:40, 50:80] = 0
        depth = torch.where(values[5] < 0.1, 0, 1 + 2 * values[6])
        return values[:3].permute(1, 2, 0), depth, values[3], values[4]

    def draw(seed: int) -> Case:
        return Case((*seen(seed + 1), CAMERA, any_pose(seed), 3 + seed % 4), "a drawn scene")

    image, depth, weight, opacity = seen(0)
    T = se3_exp(doubles(0.3, -0.1, 0.2, 0.1, -0.2, 0.05))
    start, one, zero = torch.eye(4, dtype=torch.float64), torch.ones(shape), torch.zeros(shape)
    cases = [
        Case((image, 1 + 0 * depth, one, zero, CAMERA, start, 8), "a wall and an empty map"),
        Case((image, 1 + depth, one, zero, CAMERA, T, 5), "a camera that has moved"),
        Case((image, depth, one, zero, CAMERA, T, 4), "depth that is unknown (0) in places"),
        Case((image, depth, weight, zero, CAMERA, T, 4), "a dynamic object, where the weight is 0"),
        Case((image, depth, weight, opacity, CAMERA, T, 3), "a map that covers a part"),
        *drawn(draw),
    ]
    corner = replace(CAMERA, cx=0.0, cy=0.0)
    mistakes = [
        ("unknown", "Depth 0 means unknown: insert nothing."),
        (lambda i, d, w, *a: reference(i, d, one, *a), "Weight 0 is a dynamic object: leave it."),
        (lambda *a: reference(*a[:3], zero, *a[4:]), "Parts of the map are opaque there already."),
        (lambda *a: reference(*a[:3], 1.6 - a[3], *a[4:]), "Insert where the map is transparent."),
        (lambda *a: reference(*a[:5], se3_inverse(a[5]), a[6]), "From camera to world: T^-1."),
        (lambda *a: reference(*a[:5], start, a[6]), "These means are in the camera's frame."),
        (lambda *a: reference(*a[:4], corner, *a[5:]), "A ray is (u - cx) / fx, (v - cy) / fy, 1."),
        ("one size", "A cell at depth z is cell * z / f wide."),
    ]
    return check_function(student, reference, cases, 1e-6, mistakes)


def check_map_loss(student: Function) -> Verdict:
    """Check (colour, depth, image, reference depth, weight, scales) -> Eq. (6) without SSIM.

    The answer is compared together with its derivatives by colour, depth and scales.
    """

    def reference(*a: Tensor, shares: Any = (0.8, 0.2, 10.0), flaw: str = "") -> Tensor:
        color, depth, image, reference_depth, weight, scales = a
        of_color = weight * color_loss(color, image, 0.0)
        of_depth = weight * depth_loss(depth, reference_depth, torch.inf)
        unknown = reference_depth == 0
        of_depth = of_depth + (flaw == "with unknown") * weight * unknown * depth
        of_depth = of_depth[~unknown] if flaw == "of known" else of_depth
        spread = scales - scales.mean()
        of_scales = spread.abs().mean() if flaw == "one mean" else isotropic_loss(scales)
        return shares[0] * of_color.mean() + shares[1] * of_depth.mean() + shares[2] * of_scales

    def outcome(loss: Function, *inputs: Tensor) -> Any:
        """Return the loss and its derivatives by what is optimised, 0 where it has none."""
        leaves = [values.clone().requires_grad_() for values in inputs]
        value = loss(*(leaf.clone() for leaf in leaves))
        if isinstance(value, Tensor) and value.requires_grad:
            value.sum().backward()
            value = value.detach()
        color, depth, *_, scales = leaves
        slopes = [torch.zeros_like(x) if x.grad is None else x.grad for x in (color, depth, scales)]
        return None if value is None else (value, *slopes)

    def seen(seed: int, what: str) -> Case:
        source = torch.Generator().manual_seed(seed)
        random = partial(torch.rand, generator=source, dtype=torch.float64)
        (color, image), (weight, hidden) = random(2, 5, 6, 3), random(2, 5, 6)
        depth, full = 1 + random(2, 5, 6)
        holes = torch.where(hidden < 0.3, 0, full)
        return Case((color, depth, image, holes, weight, 0.1 * random(4, 3)), what)

    thin = seen(1, "thin Gaussians")
    color, depth, image, holes, weight, needles = thin.arguments
    full, one = holes.clamp_min(1.5), torch.ones_like(depth)
    scales = (64 * needles[:, :1]).ceil().expand(4, 3) / 64  # their mean is exact: no slope
    cases = [
        Case((color, depth, image, full, one, scales), "round Gaussians and equal weights"),
        Case((color, depth, image, full, weight, scales), "weights that differ"),
        Case((color, depth, image, holes, weight, scales), "depth that is unknown in places"),
        thin,
        *drawn(lambda seed: seen(seed + 2, "drawn images")),
    ]
    mistakes = [
        (lambda *a: reference(*a[:4], one, a[5]), "Each pixel has its weight."),
        (lambda *a: reference(*a[:4], a[4] / a[4].mean(), a[5]), "Divide by the number of pixels."),
        (lambda *a: reference(*a, shares=(0.8, 0.2, 0)), "L_iso is missing."),
        (lambda *a: reference(*a, shares=(0.8, 0.2, 1)), "L_iso is multiplied by 10."),
        (lambda *a: reference(*a, shares=(2.4, 0.2, 10)), "The mean over RGB, not the sum."),
        (lambda *a: reference(*a, shares=(0.2, 0.8, 10)), "0.8 is for colour, 0.2 for depth."),
        ("one mean", "Each Gaussian has its own mean scale."),
        ("of known", "The mean is over all pixels: unknown ones count 0."),
        ("with unknown", "Depth 0 is unknown and costs nothing."),
        (lambda *a: reference(*a).detach(), "Return a tensor that autograd can differentiate."),
    ]
    returns = "the loss", *(f"its derivative by the {of}" for of in ("colour", "depth", "scales"))
    return check_function(student, reference, cases, 1e-7, mistakes, returns, outcome)


def check_followed_pose(student: Function) -> Verdict:
    """Check (map, camera, T_camera_world, image, weight, steps) -> the pose that took the image.

    The image is rendered from the true pose, so that the answer is known, whatever the method.
    What is compared is where the pose sees the centres of the Gaussians [px].
    """
    camera, count = Camera(24.0, 24.0, 15.5, 11.5, 32, 24), 60
    random = partial(torch.rand, generator=torch.Generator().manual_seed(23), dtype=torch.float64)
    depth, places, colors = (random(count, n) for n in (1, 2, 3))
    z, pixels = 1 + 3 * depth, places * doubles(40, 32) - 4
    means = camera.backproject(pixels, z[:, 0])
    quats = doubles(1, 0, 0, 0).float().expand(count, 4)
    rows = quats, (0.13 * z).log().expand(-1, 3).float()
    looks = torch.full((count,), 2.0).float(), colors.round().float()
    true_poses: dict[Tensor, Tensor] = {}  # by the first pose of the case

    def case(turn: float, start: list, what: str, mover: bool = False, last: float = 99.0) -> Case:
        """Return a case, whose map shows what lies left of `last` [px]."""
        true, weight = se3_exp(doubles(0.1, 0, 0.1, 0, turn, 0)), torch.ones(24, 32).float()
        world = transform_points(se3_inverse(true), means).float()
        gaussians = GaussianMap(world, *rows, *looks, torch.zeros(count, dtype=torch.int64))
        image = render(gaussians, camera, true.float()).color
        if mover:  # the left half of the image moves to the right
            image[:, 3:17], weight[:, :17] = image[:, :14].clone(), 0
        first = se3_exp(doubles(*start)) @ true
        true_poses[first] = true
        gaussians = gaussians.keep(pixels[:, 0] < last)
        return Case((gaussians, camera, first, image, weight, 12), what)

    def draw(seed: int) -> Case:
        return case(0.2, (0.03 * normals(seed, 6).clamp(-2, 2)).tolist(), "a drawn motion")

    cases = [
        case(0.2, [0.12, -0.09, 0.09, 0, 0, 0], "a camera that has moved"),
        case(0.8, [0.12, 0, 0, 0, 0, 0.09], "a camera that has turned"),
        case(0.2, [-0.03, 0.03, 0, 0, 0, 0], "an object that moves in the image", mover=True),
        case(0.2, [0.04, -0.03, 0.03, 0, 0, 0], "a map of half of the image", last=14.0),
        case(2.5, [0.12, -0.09, 0.09, 0, 0, 0], "a camera that looks back"),
        *drawn(draw),
    ]

    def true_pose(*a: Any) -> Tensor:
        return true_poses[a[2]]

    def pixels_of(follow: Function, *a: Any) -> Any:
        answer = follow(*a)
        if answer is None:
            return None
        pose = torch.as_tensor(answer)
        if pose.shape != (4, 4):
            raise ValueError(f"a pose (4, 4) is asked for, found {tuple(pose.shape)}")
        return (camera.project(transform_points(pose.double(), a[0].means.double())),)

    def motion(*a: Any) -> Tensor:
        return true_pose(*a) @ se3_inverse(a[2])

    def refined(*a: Any, steps: int) -> Tensor:
        gaussians, camera, start, image, weight, *_ = a
        view, black = (start, image, weight), torch.zeros(3).to(image)
        settings = PoseRefinementConfig(iterations=steps, tolerance=0.0)
        return pose_refinement.refine_pose(gaussians, camera, *view, black, settings)

    # Its first step is damped by 0.3 times this: by 0.1, as in the exercise.
    one_step = patch.object(pose_refinement, "_FIRST_DAMPING", 1 / 3)(partial(refined, steps=1))
    mistakes = [
        (lambda *a: a[2], "The pose has not moved: return exp(twist) times the first pose."),
        (lambda *a: se3_inverse(true_pose(*a)), "This is T_world_camera."),
        (motion, "This is the motion alone."),
        (lambda *a: a[2] @ motion(*a), "The twist is applied on the left: exp(twist) @ T."),
        (lambda *a: se3_inverse(motion(*a)) @ a[2], "The pose moves the other way."),
        (one_step, "Repeat the step, each time from the pose of the last one."),
        (lambda *a: refined(*a[:4], a[4] ** 0, steps=30), "Something moves: use the weight."),
    ]
    returns = ("the Gaussians' pixels",)
    return check_function(student, true_pose, cases, 0.02, mistakes, returns, pixels_of)
