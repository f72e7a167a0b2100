"""Exercises of notebook 09: the light of a phone, and how far apart frames have to be."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from minislam.checks.cases import Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function


def check_gains(student: Function) -> Verdict:
    """Check (first (N, 3), second (N, 3)): colours of points -> gain (3,) of each channel."""

    def reference(*a: Tensor, low: float = 0.05, high: float = 0.95, flaw: str = "") -> Tensor:
        both = (torch.minimum(*a) > low) & (torch.maximum(*a) < high)
        both &= both.all(1, keepdim=True) | (flaw != "together")
        ratios = torch.where(both, a[1] / a[0], torch.nan)
        return ratios.nanquantile(0.5, 0, interpolation="lower" if flaw == "lower" else "linear")

    def case(seed: int, gain: float, what: str) -> Case:
        first, noise = normals(seed, 2, 23, 3).sigmoid()
        first = 0.15 + 0.5 * first
        second = first * doubles(gain, 1, 1 / gain) * (1 + 0.02 * noise)
        second[:5] = doubles(0.97, 0.6, 0.01)  # something moves there
        second[5], first[6], second[7] = 0.99, 0.98, 0.01
        first[9] = 0.01
        second[8, 0] = 0.96  # of this point, green and blue can still be used
        return Case((first, second), what)

    cases = [
        case(1, 1.25, "a second frame that is warmer"),
        case(2, 0.8, "a colder one"),
        *drawn(lambda seed: case(seed + 9, 1.1, "drawn colours")),
    ]
    mistakes = [
        (lambda *a: reference(*a, low=-1, high=2), "Saturated or dark values are no proportion."),
        (lambda *a: reference(*a, low=-1), "Values below 0.05 are nearly all noise."),
        ("lower", "torch.median takes the lower of two."),
        (lambda *a: reference(*a, high=2.0), "Values above 0.95 are cut off."),
        ("together", "Each channel has its own usable points: one may be too bright in red alone."),
        (lambda a, b: reference(b, a), "This is the gain from the second frame to the first."),
        (lambda a, b: (b / a).mean(0), "A mean follows what moves: take the median."),
        (lambda a, b: reference(a, b).mean().expand(3), "Each channel has a gain of its own."),
    ]
    return check_function(student, reference, cases, 1e-6, mistakes)


def check_stride(student: Function) -> Verdict:
    """Check (rays (N, 2), flows (S, M, N, 2), strides, needed) -> parallaxes (S,), stride."""

    def turned(rays: Tensor, curve: float = 1.0) -> Tensor:  # (N, 2, 3)
        """Return how points of the rays (x, y, 1) move in the image, by a turn about each axis."""
        x, y = rays.T
        across = torch.stack([-x * y, 1 + curve * x * x, -y], 1)
        down = torch.stack([-(1 + curve * y * y), x * y, x], 1)
        return torch.stack([across, down], 1)

    def without_turn(rays: Tensor, flow: Tensor, flaw: str) -> Tensor:  # (N, 2)
        if flaw in ("whole", "shifted"):
            return flow - (flaw == "shifted") * flow.mean(0)
        turns = turned(rays, flaw != "flat")[..., : 2 if flaw == "no roll" else 3]
        weight, rest = torch.ones_like(flow[:, 0]), flow
        for _ in range({"once": 1, "eleven": 11}.get(flaw, 10)):
            H = torch.einsum("n,nki,nkj->ij", weight, turns, turns)
            g = torch.einsum("n,nki,nk->i", weight, turns, flow)
            rest = flow - turns @ torch.linalg.solve(H, g)
            weight = rest.norm(dim=1).clamp_min(0.5) ** (-2 if flaw == "squared" else -1)
        return rest

    def found(*a: Any, flaw: str = "") -> tuple[Tensor, int]:
        rays, flows, strides, needed = a
        middles: dict[str, Function] = {"mean": torch.mean, "lower": torch.median}
        middle = middles.get(flaw, partial(torch.quantile, q=0.5))
        pairs = [[middle(without_turn(rays, f, flaw).norm(dim=1)) for f in fs] for fs in flows]
        parallaxes = torch.stack([middle(torch.stack(of_stride)) for of_stride in pairs])
        enough = [s for s, p in zip(strides, parallaxes, strict=True) if p >= needed]
        if not enough:
            return parallaxes, strides[-1] if flaw == "never 0" else 0
        stride = strides[-1] if flaw == "largest" else enough[0]
        return parallaxes, strides.index(stride) if flaw == "place" else stride

    def case(seed: int, parallax: float, needed: float, what: str) -> Case:
        """Return flow of a camera that turns and walks, with somebody in the view."""
        rays = 0.6 * normals(seed, 40, 2).clamp(-1.5, 1.5)
        flow = turned(rays) @ (doubles(2, -3, 5) + normals(seed + 1, 3))
        flow = flow + parallax * normals(seed + 2, 4, 40, 2)
        flow[:, :9] += doubles(12, 4)  # somebody walks there
        strides = [1, 2, 4]
        return Case((rays, torch.stack([s * flow for s in strides]), strides, needed), what)

    cases = [
        case(3, 1.0, 2.0, "a camera that walks"),
        case(4, 0.02, 2.0, "a camera that only turns"),
        case(5, 4.0, 1.0, "a camera that runs"),
        *drawn(lambda seed: case(seed + 20, 0.7, 1.5, "a drawn walk")),
    ]
    mistakes = [
        ("once", "Weigh by 1/max(residual, 0.5) and fit anew, ten times in all."),
        ("eleven", "Ten fits in all: one with equal weights, and nine more."),
        ("squared", "The weight is 1/residual, not 1/residual^2."),
        ("no roll", "The third column, a roll about the viewing axis, is missing."),
        ("flat", "Away from the centre a turn moves a point more: 1 + x^2, 1 + y^2."),
        ("whole", "This is the whole flow: take away what a turn explains."),
        ("shifted", "A turn is not the mean flow."),
        ("mean", "Take medians: the mean follows what moves."),
        ("lower", "torch.median takes the lower of two."),
        ("largest", "The smallest stride that suffices, please."),
        ("never 0", "Where no stride suffices, the answer is 0."),
        ("place", "Not its place in the list: the stride."),
    ]
    returns = "the parallax of each stride", "the stride"
    return check_function(student, found, cases, 1e-4, mistakes, returns=returns)
