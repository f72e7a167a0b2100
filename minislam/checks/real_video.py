"""Exercises of notebook 09: the light of a phone, and how far apart frames have to be."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from minislam.checks.grading import Case, Function, Hints, Verdict, check_function, normals

DARKEST, BRIGHTEST = 0.05, 0.95  # of a channel, between which a sensor answers in proportion
_ROUNDS = 10
_LEAST = 0.5  # px, below which a residual gains no more weight


def _median(values: Tensor) -> Tensor:
    return values.quantile(0.5)


def check_gains(student: Callable[[Tensor, Tensor], Tensor]) -> Verdict:
    """Check (first (N, 3), second (N, 3)): colours of points -> gain (3,) of each channel."""

    def reference(
        first: Tensor, second: Tensor, lowest: float = DARKEST, highest: float = BRIGHTEST
    ) -> Tensor:
        def usable(values: Tensor) -> Tensor:
            return (values > lowest) & (values < highest)

        both = usable(first) & usable(second)
        ratios = [(second[both[:, k], k] / first[both[:, k], k]).quantile(0.5) for k in range(3)]
        return torch.stack(ratios)

    def case(seed: int, gain: float, what: str) -> Case:
        source = torch.Generator().manual_seed(seed)
        first = 0.15 + 0.5 * torch.rand((23, 3), generator=source, dtype=torch.float64)
        second = first * torch.tensor([gain, 1.0, 1 / gain], dtype=torch.float64)
        second = second * (1 + 0.02 * torch.rand((23, 3), generator=source, dtype=torch.float64))
        second[:5] = torch.tensor([0.97, 0.6, 0.01], dtype=torch.float64)  # something moves there
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
    cases = [case(1, 1.25, "a second frame that is warmer"), case(2, 0.8, "a colder one")]
    return check_function(
        student, reference, cases, 1e-6, hints, lambda seed: case(seed + 9, 1.1, "drawn colours")
    )


def check_stride(student: Callable[..., tuple[Tensor, int]]) -> Verdict:
    """Check (rays (N, 2), flows (S, M, N, 2), strides, needed) -> parallaxes (S,), stride."""
    reference = stride_finder()

    def changed(choose: Callable[[int, list[int]], int]) -> Function:
        def answer(rays: Tensor, flows: Tensor, strides: list[int], needed: float) -> Any:
            parallaxes, stride = reference(rays, flows, strides, needed)
            return parallaxes, choose(stride, strides)

        return answer

    hints: Hints = [
        (
            stride_finder(partial(lengths_without_turn, rounds=1)),
            "Weigh by 1/max(residual, 0.5) and fit anew, ten times in all.",
        ),
        (
            stride_finder(partial(lengths_without_turn, power=2.0)),
            "The weight is 1/residual, not 1/residual^2.",
        ),
        (
            stride_finder(partial(lengths_without_turn, columns=2)),
            "The third column, a roll about the viewing axis, is missing.",
        ),
        (
            stride_finder(partial(lengths_without_turn, curve=0.0)),
            "Away from the centre a turn moves a point more: 1 + x^2, 1 + y^2.",
        ),
        (stride_finder(middle=torch.mean), "Take medians: the mean follows what moves."),
        (
            stride_finder(lambda _, flow: flow.norm(dim=1)),
            "This is the whole flow: take away what a turn explains.",
        ),
        (
            stride_finder(lambda _, flow: (flow - flow.mean(0)).norm(dim=1)),
            "A turn is not the mean flow: it moves points at the border more.",
        ),
        (
            changed(lambda stride, strides: strides[-1] if stride else 0),
            "The smallest stride that suffices is asked for.",
        ),
        (
            changed(lambda stride, strides: stride or strides[-1]),
            "Where no stride suffices, the answer is 0.",
        ),
        (
            changed(lambda stride, strides: strides.index(stride) if stride else 0),
            "Return the stride itself, not its place in the list.",
        ),
    ]
    cases = [
        _walk(3, 1.0, 2.0, "a camera that walks"),
        _walk(4, 0.02, 2.0, "a camera that only turns"),
        _walk(5, 4.0, 1.0, "a camera that runs"),
    ]
    returns = "the parallax of each stride", "the stride"

    def draw(seed: int) -> Case:
        return _walk(seed + 20, 0.7, 1.5, "a drawn walk")

    return check_function(student, reference, cases, 1e-4, hints, draw, returns)


def lengths_without_turn(
    rays: Tensor,  # (N, 2)
    flow: Tensor,  # (N, 2) px
    rounds: int = _ROUNDS,
    power: float = 1.0,  # of the residual in the weight of a fit
    columns: int = 3,  # axes of the turn
    curve: float = 1.0,
) -> Tensor:  # (N,) px
    """Return how long the flow still is without the turn that explains most of it."""
    x, y = rays.T
    across = torch.stack([-x * y, 1 + curve * x * x, -y], 1)
    down = torch.stack([-(1 + curve * y * y), x * y, x], 1)
    turned = torch.stack([across, down], 1)[..., :columns]
    weight, rest = torch.ones_like(x), flow
    for _ in range(rounds):
        H = torch.einsum("n,nki,nkj->ij", weight, turned, turned)
        g = torch.einsum("n,nki,nk->i", weight, turned, flow)
        rest = flow - turned @ torch.linalg.solve(H, g)
        weight = rest.norm(dim=1).clamp_min(_LEAST) ** -power
    return rest.norm(dim=1)


def stride_finder(
    lengths: Callable[[Tensor, Tensor], Tensor] = lengths_without_turn,
    middle: Callable[[Tensor], Tensor] = _median,
) -> Function:
    """Return the answer to the exercise, with a length of the flow and a middle of one's own."""

    def answer(rays: Tensor, flows: Tensor, strides: list[int], needed: float) -> Any:
        pairs = [[middle(lengths(rays, flow)) for flow in of_stride] for of_stride in flows]
        found = torch.stack([middle(torch.stack(of_stride)) for of_stride in pairs])
        enough = [s for s, parallax in zip(strides, found, strict=True) if parallax >= needed]
        return found, enough[0] if enough else 0

    return answer


def _walk(seed: int, parallax: float, needed: float, what: str) -> Case:
    """Return flow of a camera that turns and walks, with somebody in the view."""
    rays = 0.6 * normals(seed, 41, 2).clamp(-1.5, 1.5)
    x, y = rays.T
    turn = torch.tensor([2.0, -3.0, 5.0], dtype=torch.float64) + normals(seed + 1, 3)
    across = torch.stack([-x * y, 1 + x * x, -y], 1) @ turn
    down = torch.stack([-(1 + y * y), x * y, x], 1) @ turn
    flow = torch.stack([across, down], 1) + parallax * normals(seed + 2, 3, 41, 2)
    flow[:, :9] += torch.tensor([12.0, 4.0], dtype=torch.float64)  # somebody walks there
    strides = [1, 2, 4]
    flows = torch.stack([stride * flow for stride in strides])
    return Case((rays, flows, strides, needed), what)
