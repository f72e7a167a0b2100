"""Eqs. (1) and (2) on blocks of pixels, against plain formulas and autograd."""

import pytest
import torch
from torch import Tensor

from minislam.splatting.compositing import (
    CHUNK,
    Workspace,
    composite,
    composite_vjp,
    log_alpha_coefficients,
    log_alpha_coefficients_vjp,
    moments_vjp,
    monomials,
)
from minislam.splatting.constants import MIN_ALPHA
from minislam.splatting.tiles import PIXELS
from tests.helpers import assert_gradients_close, generator, numerical_gradient

pytestmark = pytest.mark.slow

TILES = 2


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def conics_of(seed: int, count: int) -> Tensor:
    a, b, c = normal(seed, 3, count)
    return torch.stack([0.05 + a.abs(), 0.1 * b, 0.05 + c.abs()])


def block(seed: int, slots: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return coefficients (6, K * B), channels (K, B, 4) and background (4,)."""
    count = slots * TILES
    offsets, log_opacities = 4 * normal(seed, 2, count), -normal(seed + 1, count).abs() - 0.02
    coefficients = log_alpha_coefficients(offsets, 0.1 * conics_of(seed + 2, count), log_opacities)
    return coefficients, normal(seed + 3, slots, TILES, 4), normal(seed + 4, 4)


def composite_plainly(coefficients: Tensor, channels: Tensor, background: Tensor) -> Tensor:
    """Return what the tiles show (B, 5, P): channels and opacity, as Eq. (2) is written."""
    alphas = (coefficients.T @ monomials(channels)).exp().view(-1, TILES, PIXELS)
    alphas = alphas * (alphas > MIN_ALPHA)
    transmittance = torch.ones(TILES, PIXELS, dtype=torch.float64)
    shown = torch.zeros(TILES, 4, PIXELS, dtype=torch.float64)
    for k, alpha in enumerate(alphas):
        shown = shown + channels[k, :, :, None] * (transmittance * alpha)[:, None]
        transmittance = transmittance * (1 - alpha)
    shown = shown + background[:, None] * transmittance[:, None]
    return torch.cat([shown, 1 - transmittance[:, None]], 1)


def composite_block(coefficients: Tensor, channels: Tensor, background: Tensor) -> Tensor:
    inside = torch.ones(TILES, PIXELS, dtype=torch.float64)
    workspace = Workspace(TILES, channels)
    out = composite(coefficients, channels, background, inside, workspace)
    return torch.cat([out.channels, 1 - out.transmittance[:, None]], 1)


# Known answers


def test_exponent_at_the_mean_is_the_log_opacity():
    offsets = torch.tensor([[0.5], [-1.5]], dtype=torch.float64)  # px, on a pixel centre
    coefficients = log_alpha_coefficients(
        offsets, conics_of(0, 1), torch.tensor([-0.3], dtype=torch.float64)
    )
    at = (monomials(offsets)[1] == 0.5) & (monomials(offsets)[2] == -1.5)
    value = (coefficients.T @ monomials(offsets))[0, at]
    assert value.item() == pytest.approx(-0.3, abs=1e-14)


def test_weight_sums_add_up_the_blending_weight_of_each_slot():
    coefficients, channels, background = block(1, slots=2)
    inside = torch.ones(TILES, PIXELS, dtype=torch.float64)
    out = composite(coefficients, channels, background, inside, Workspace(TILES, channels))
    alphas = (coefficients.T @ monomials(channels)).exp().view(2, TILES, PIXELS)
    alphas = alphas * (alphas > MIN_ALPHA)
    torch.testing.assert_close(out.weight_sums[0], alphas[0].sum(1))
    torch.testing.assert_close(out.weight_sums[1], (alphas[1] * (1 - alphas[0])).sum(1))


# Identities


@pytest.mark.parametrize("slots", [1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 5])
def test_chunks_give_the_plain_sum(slots: int):
    inputs = block(slots, slots)
    torch.testing.assert_close(
        composite_block(*inputs), composite_plainly(*inputs), rtol=1e-12, atol=1e-12
    )


def test_pixels_beyond_the_border_show_and_count_nothing():
    coefficients, channels, background = block(3, slots=5)
    inside = torch.zeros(TILES, PIXELS, dtype=torch.float64)
    out = composite(coefficients, channels, background, inside, Workspace(TILES, channels))
    assert out.channels.abs().max() == 0
    assert out.weight_sums.abs().max() == 0


# Gradients


@pytest.mark.parametrize("seed", range(20))
def test_log_alpha_coefficients_and_moments_vjp(seed: int):
    offsets, conics, logs = 3 * normal(seed, 2, 4), conics_of(seed, 4), -normal(seed, 4).abs()
    cotangent = normal(seed + 1, 6, 4)
    leaves = [value.clone().requires_grad_() for value in (logs, offsets, conics)]
    (log_alpha_coefficients(leaves[1], leaves[2], leaves[0]) * cotangent).sum().backward()
    actual = moments_vjp(conics, log_alpha_coefficients_vjp(offsets, cotangent))
    for ours, leaf in zip(actual, leaves, strict=True):
        assert_gradients_close(ours, leaf.grad, relative=1e-10)
    numerical = numerical_gradient(
        lambda m: (log_alpha_coefficients(m, conics, logs) * cotangent).sum(), offsets
    )
    assert_gradients_close(actual[1], numerical, relative=1e-7)


@pytest.mark.parametrize("slots", [1, CHUNK, 2 * CHUNK + 3])
@pytest.mark.parametrize("seed", range(7))
def test_composite_vjp(slots: int, seed: int):
    coefficients, channels, background = block(seed, slots)
    cotangent = normal(seed + 7, TILES, 5, PIXELS)
    leaves = [coefficients.clone().requires_grad_(), channels.clone().requires_grad_()]
    (composite_plainly(*leaves, background) * cotangent).sum().backward()

    inside = torch.ones(TILES, PIXELS, dtype=torch.float64)
    workspace = Workspace(TILES, channels)
    checkpoints = composite(coefficients, channels, background, inside, workspace).checkpoints
    actual = composite_vjp(
        coefficients, channels, background, checkpoints,
        cotangent[:, :4].contiguous(), -cotangent[:, 4], workspace,
    )  # fmt: skip
    for ours, leaf in zip(actual, leaves, strict=True):
        assert_gradients_close(ours, leaf.grad, relative=1e-10)
        assert (ours != 0).double().mean() > 0.5  # the test would pass on zeros otherwise

    def varied(value: Tensor) -> Tensor:
        return (composite_plainly(coefficients, value, background) * cotangent).sum()

    assert_gradients_close(actual[1], numerical_gradient(varied, channels), relative=1e-7)


# Degenerate input


def test_many_opaque_slots_give_finite_gradients():
    slots = 40
    coefficients = torch.zeros(6, slots * TILES, dtype=torch.float32)
    coefficients[0] = -0.01  # alpha 0.99 everywhere: T falls to 1e-80, below any float32
    channels = torch.ones(slots, TILES, 4)
    workspace = Workspace(TILES, channels)
    background, inside = torch.zeros(4), torch.ones(TILES, PIXELS)
    out = composite(coefficients, channels, background, inside, workspace)
    v_coefficients, v_channels = composite_vjp(
        coefficients, channels, background, out.checkpoints,
        torch.ones(TILES, 4, PIXELS), torch.zeros(TILES, PIXELS), workspace,
    )  # fmt: skip
    torch.testing.assert_close(out.channels, torch.ones(TILES, 4, PIXELS))
    assert v_coefficients.isfinite().all() and v_channels.isfinite().all()
