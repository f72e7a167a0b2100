"""Shared by the tests: derivative checks with stated tolerances, and random transforms."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.checks import NOT_YET, PASSED, WRONG
from minislam.geometry import se3_exp
from minislam.records import Frame


def generator(seed: int) -> torch.Generator:
    """Return an explicit random source; no test uses the global one."""
    return torch.Generator().manual_seed(seed)


def frame_of(image: Tensor, frame_index: int = 0) -> Frame:
    """Return an image (H, W, 3) as a frame, ten per second."""
    return Frame(frame_index, frame_index / 10, image)


def numerical_jacobian(function: Callable[[Tensor], Tensor], x: Tensor, step: float = 1e-6):
    """Return d function / d x by central differences, shape (*output, *input), float64."""
    flat = x.detach().double().reshape(-1)
    columns = []
    for index in range(flat.numel()):
        offset = torch.zeros_like(flat)
        offset[index] = step * max(1.0, abs(float(flat[index])))
        forward = function((flat + offset).reshape(x.shape))
        backward = function((flat - offset).reshape(x.shape))
        columns.append((forward - backward) / (2 * offset[index]))
    return torch.stack(columns, -1).reshape(*columns[0].shape, *x.shape)


def numerical_gradient(function: Callable[[Tensor], Tensor], x: Tensor, step: float = 1e-6):
    """Return the gradient of a scalar function by central differences."""
    return numerical_jacobian(lambda value: function(value).reshape(()), x, step)


def assert_gradients_close(
    actual: Tensor, expected: Tensor, relative: float = 1e-7, absolute: float = 1e-9
) -> None:
    """Assert element-wise closeness, relative L2 and direction of two gradients.

    One criterion alone lets errors pass: a norm hides one wrong element among many large ones,
    an element-wise test hides a small systematic error in all of them.
    """
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    assert torch.isfinite(actual).all(), "gradient is not finite"
    difference = (actual - expected).abs()
    bound = absolute + 10 * relative * expected.abs()
    scale = expected.norm()
    worst = (difference - bound).max()
    assert worst <= 10 * relative * scale, f"element differs by {float(difference.max()):.3e}"
    if scale > absolute:
        error = float((actual - expected).norm() / scale)
        assert error <= relative, f"relative L2 error {error:.3e} > {relative:.1e}"
        cosine = float((actual * expected).sum() / (actual.norm() * scale))
        assert cosine >= 1 - max(1e-10, relative), f"cosine {cosine:.12f}"


def random_transforms(count: int, regime: str, seed: int) -> Tensor:
    """Return transforms (count, 4, 4) float64: "normal", "tiny" or "half_turn" rotations."""
    source = generator(seed)
    xi = torch.randn(count, 6, generator=source, dtype=torch.float64)
    axis = xi[:, 3:] / xi[:, 3:].norm(dim=-1, keepdim=True)
    angle = {
        "normal": 3.0 * torch.rand(count, 1, generator=source, dtype=torch.float64),
        "tiny": 1e-7 * torch.rand(count, 1, generator=source, dtype=torch.float64),
        "half_turn": torch.pi - 1e-7 * torch.rand(count, 1, generator=source, dtype=torch.float64),
    }[regime]
    return se3_exp(torch.cat([xi[:, :3], angle * axis], -1))


def unfinished(*arguments: object) -> Tensor:
    """Stand in for an exercise that has not been begun."""
    raise NotImplementedError


def _scaled(factor: float, answer: Tensor | tuple[Tensor, ...]) -> Tensor | tuple[Tensor, ...]:
    if isinstance(answer, tuple):
        return tuple(factor * part for part in answer)
    return factor * answer


def assert_graded(check: Callable, solution: Callable) -> None:
    """Assert that a check passes a solution, waits for an empty one, and rejects wrong ones.

    Wrong are a flipped sign and an error of 1 %; the sentence holds the first wrong number.
    """
    assert check(solution).status == PASSED
    assert check(unfinished).status == NOT_YET
    assert check(lambda *arguments: None).status == NOT_YET
    for factor in (-1, 1.01):
        verdict = check(lambda *a, factor=factor: _scaled(factor, solution(*a)))
        assert verdict.status == WRONG and ", expected " in verdict.sentence
        assert repr(verdict).startswith("Wrong: for ")


def assert_variants(
    check: Callable, right: dict[str, Callable], wrong: dict[str, Callable], named: float = 0.7
) -> None:
    """Assert that a check passes all right variants, refuses all wrong ones, and names most.

    `named` is the smallest fraction of the wrong ones that get a hint.
    """
    assert len(right) >= 2 and len(wrong) >= 6
    for name, answer in right.items():
        verdict = check(answer)
        assert verdict.status == PASSED, f"{name}: {verdict}"
    verdicts = {name: check(answer) for name, answer in wrong.items()}
    for name, verdict in verdicts.items():
        assert verdict.status == WRONG, f"{name}: {verdict}"
    unnamed = [f"{name}: {v}" for name, v in verdicts.items() if not v.hint]
    assert len(unnamed) <= (1 - named) * len(wrong), unnamed
