"""Exercises of notebook 09: the light of a phone, and how far apart frames have to be."""

from functools import partial

import torch
from torch import Tensor

from minislam.checks.cases import Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function

DARKEST, BRIGHTEST = 0.05, 0.95  # of a channel, between which a sensor answers in proportion
_ROUNDS = 10
_LEAST = 0.5  # px, below which a residual gains no more weight
_median = partial(torch.quantile, q=0.5)


def check_gains(student: Function) -> Verdict:
    """Check (first (N, 3), second (N, 3)): colours of points -> gain (3,) of each channel."""

    def reference(
        first: Tensor, second: Tensor, lowest: float = DARKEST, highest: float = BRIGHTEST
    ) -> Tensor:
        both = (torch.minimum(first, second) > lowest) & (torch.maximum(first, second) < highest)
        ratio = torch.where(both, second / first, torch.nan)
        return ratio.nanquantile(0.5, dim=0)

    def case(seed: int, gain: float, what: str) -> Case:
        first, noise = normals(seed, 2, 23, 3).sigmoid()
        first = 0.15 + 0.5 * first
        second = first * doubles(gain, 1, 1 / gain) * (1 + 0.02 * noise)
        second[:5] = doubles(0.97, 0.6, 0.01)  # something moves there
        second[5], first[6], second[7] = 0.99, 0.98, 0.01
        second[8, 0] = 0.96  # of this point, green and blue can still be used
        return Case((first, second), what)

    hints = [
        (lambda a, b: reference(a, b, -1.0, 2.0), "Saturated or dark values are no proportion."),
        (lambda a, b: reference(a, b, -1.0), "Values below 0.05 are nearly all noise."),
        (lambda a, b: reference(a, b, highest=2.0), "Values above 0.95 are cut off."),
        (lambda a, b: reference(b, a), "This is the gain from the second frame to the first."),
        (lambda a, b: (b / a).mean(0), "A mean follows what moves: take the median."),
        (lambda a, b: reference(a, b).mean().expand(3), "Each channel has a gain of its own."),
    ]
    cases = [
        case(1, 1.25, "a second frame that is warmer"),
        case(2, 0.8, "a colder one"),
        *drawn(lambda seed: case(seed + 9, 1.1, "drawn colours")),
    ]
    return check_function(student, reference, cases, 1e-6, hints)


def check_stride(student: Function) -> Verdict:
    """Check (rays (N, 2), flows (S, M, N, 2), strides, needed) -> parallaxes (S,), stride."""
    find, rest = parallaxes_and_stride, lengths_without_turn

    def choice(choose: Function) -> Function:
        return lambda *a: ((found := find(*a))[0], choose(found[1], a[2]))

    flaws: dict[str, Function] = {
        "Weigh by 1/max(residual, 0.5) and fit anew, ten times in all.": partial(rest, rounds=1),
        "The weight is 1/residual, not 1/residual^2.": partial(rest, power=2.0),
        "The third column, a roll about the viewing axis, is missing.": partial(rest, columns=2),
        "Away from the centre a turn moves a point more: 1 + x^2, 1 + y^2.": partial(rest, curve=0),
        "This is the whole flow: take away what a turn explains.": lambda _, f: f.norm(dim=1),
        "A turn is not the mean flow.": lambda _, f: (f - f.mean(0)).norm(dim=1),
    }
    hints: list = [(partial(find, lengths=flaw), hint) for hint, flaw in flaws.items()]
    hints += [
        (partial(find, middle=torch.mean), "Take medians: the mean follows what moves."),
        (choice(lambda s, all: all[-1] if s else 0), "The smallest stride that suffices, please."),
        (choice(lambda s, all: s or all[-1]), "Where no stride suffices, the answer is 0."),
        (choice(lambda s, all: all.index(s) if s else 0), "Not its place in the list: the stride."),
    ]
    cases = [
        _walk(3, 1.0, 2.0, "a camera that walks"),
        _walk(4, 0.02, 2.0, "a camera that only turns"),
        _walk(5, 4.0, 1.0, "a camera that runs"),
        *drawn(lambda seed: _walk(seed + 20, 0.7, 1.5, "a drawn walk")),
    ]
    returns = "the parallax of each stride", "the stride"
    return check_function(student, find, cases, 1e-4, hints, returns=returns)


def lengths_without_turn(
    rays: Tensor,  # (N, 2)
    flow: Tensor,  # (N, 2) px
    rounds: int = _ROUNDS,
    power: float = 1.0,  # of the residual in the weight of a fit
    columns: int = 3,  # axes of the turn
    curve: float = 1.0,
) -> Tensor:  # (N,) px
    """Return how long the flow still is without the turn that explains most of it."""
    turned = _turned(rays, curve)[..., :columns]
    weight, rest = torch.ones_like(flow[:, 0]), flow
    for _ in range(rounds):
        H = torch.einsum("n,nki,nkj->ij", weight, turned, turned)
        g = torch.einsum("n,nki,nk->i", weight, turned, flow)
        rest = flow - turned @ torch.linalg.solve(H, g)
        weight = rest.norm(dim=1).clamp_min(_LEAST) ** -power
    return rest.norm(dim=1)


def parallaxes_and_stride(
    rays: Tensor,  # (N, 2)
    flows: Tensor,  # (S, M, N, 2) px
    strides: list[int],
    needed: float,  # px
    lengths: Function = lengths_without_turn,
    middle: Function = _median,
) -> tuple[Tensor, int]:
    """Return the answer to the exercise, with a length of the flow and a middle of one's own."""
    pairs = [[middle(lengths(rays, flow)) for flow in of_stride] for of_stride in flows]
    found = torch.stack([middle(torch.stack(of_stride)) for of_stride in pairs])
    enough = [s for s, parallax in zip(strides, found, strict=True) if parallax >= needed]
    return found, enough[0] if enough else 0


def _walk(seed: int, parallax: float, needed: float, what: str) -> Case:
    """Return flow of a camera that turns and walks, with somebody in the view."""
    rays = 0.6 * normals(seed, 41, 2).clamp(-1.5, 1.5)
    flow = _turned(rays) @ (doubles(2, -3, 5) + normals(seed + 1, 3))
    flow = flow + parallax * normals(seed + 2, 3, 41, 2)
    flow[:, :9] += doubles(12, 4)  # somebody walks there
    strides = [1, 2, 4]
    flows = torch.stack([stride * flow for stride in strides])
    return Case((rays, flows, strides, needed), what)


def _turned(rays: Tensor, curve: float = 1.0) -> Tensor:  # (N, 2, 3)
    """Return how points of the rays (x, y, 1) move in the image, by a turn about each axis."""
    x, y = rays.T
    across = torch.stack([-x * y, 1 + curve * x * x, -y], 1)
    down = torch.stack([-(1 + curve * y * y), x * y, x], 1)
    return torch.stack([across, down], 1)
