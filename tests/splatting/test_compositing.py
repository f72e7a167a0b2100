"""Eqs. (1) and (2) on blocks of pixels, against plain formulas and autograd."""

import pytest
import torch
from torch import Tensor

from minislam.splatting.compositing import (
    Workspace,
    composite,
    composite_vjp,
    log_alpha_coefficients,
    log_alpha_coefficients_vjp,
    moments_vjp,
    monomials,
)
from minislam.splatting.constants import MIN_ALPHA
from minislam.splatting.tiles import CHUNK, PIXELS, Chunk
from tests.helpers import assert_gradients_close, generator, numerical_gradient

pytestmark = pytest.mark.slow

TILES = 2


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def conics_of(seed: int, count: int) -> Tensor:
    a, b, c = normal(seed, 3, count)
    return torch.stack([0.05 + a.abs(), 0.1 * b, 0.05 + c.abs()])


def chunks_of(slots: int) -> list[Chunk]:
    """Return chunks of so many slots: from the second on only the last tile has any."""
    first = range(0, slots, CHUNK)
    return [Chunk(min(CHUNK, slots - k), TILES if k == 0 else 1) for k in first]


def block(seed: int, slots: int) -> tuple[list[Chunk], Tensor, Tensor, Tensor]:
    """Return chunks, coefficients (6, S), channels (S, 4) and background (4,)."""
    chunks = chunks_of(slots)
    count = sum(chunk.slots * chunk.tiles for chunk in chunks)
    offsets, log_opacities = 4 * normal(seed, 2, count), -normal(seed + 1, count).abs() - 0.02
    coefficients = log_alpha_coefficients(offsets, 0.1 * conics_of(seed + 2, count), log_opacities)
    return chunks, coefficients, normal(seed + 3, count, 4), normal(seed + 4, 4)


def composite_plainly(
    chunks: list[Chunk], coefficients: Tensor, channels: Tensor, background: Tensor
) -> Tensor:
    """Return what the tiles show (B, 5, P): channels and opacity, as Eq. (2) is written."""
    alphas = (coefficients.T @ monomials(channels)).exp()
    alphas = alphas * (alphas > MIN_ALPHA)
    columns = [torch.arange(TILES - tiles, TILES).repeat(slots) for slots, tiles in chunks]
    tile_of_slot = torch.cat(columns)
    images = []
    for tile in range(TILES):
        transmittance = torch.ones(PIXELS, dtype=torch.float64)
        shown = torch.zeros(4, PIXELS, dtype=torch.float64)
        mine = tile_of_slot == tile
        for alpha, channel in zip(alphas[mine], channels[mine], strict=True):
            shown = shown + channel[:, None] * (transmittance * alpha)
            transmittance = transmittance * (1 - alpha)
        shown = shown + background[:, None] * transmittance
        images.append(torch.cat([shown, 1 - transmittance[None]]))
    return torch.stack(images)


def composite_block(
    chunks: list[Chunk], coefficients: Tensor, channels: Tensor, background: Tensor
) -> Tensor:
    inside = torch.ones(TILES, PIXELS, dtype=torch.float64)
    workspace = Workspace(chunks, channels)
    out = composite(chunks, coefficients, channels, background, inside, workspace)
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
    chunks, coefficients, channels, background = block(1, slots=2)
    inside = torch.ones(TILES, PIXELS, dtype=torch.float64)
    out = composite(chunks, coefficients, channels, background, inside, Workspace(chunks, channels))
    alphas = (coefficients.T @ monomials(channels)).exp().view(2, TILES, PIXELS)
    alphas = alphas * (alphas > MIN_ALPHA)
    expected = torch.cat([alphas[0], alphas[1] * (1 - alphas[0])])
    torch.testing.assert_close(out.weight_sums, expected.sum(1))


# Identities


@pytest.mark.parametrize("slots", [1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK + 5])
def test_chunks_give_the_plain_sum(slots: int):
    inputs = block(slots, slots)
    torch.testing.assert_close(
        composite_block(*inputs), composite_plainly(*inputs), rtol=1e-12, atol=1e-12
    )


def test_pixels_beyond_the_border_show_and_count_nothing():
    chunks, *inputs = block(3, slots=5)
    inside = torch.zeros(TILES, PIXELS, dtype=torch.float64)
    out = composite(chunks, *inputs, inside, Workspace(chunks, inside))
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
    chunks, coefficients, channels, background = block(seed, slots)
    cotangent = normal(seed + 7, TILES, 5, PIXELS)
    leaves = [coefficients.clone().requires_grad_(), channels.clone().requires_grad_()]
    (composite_plainly(chunks, *leaves, background) * cotangent).sum().backward()

    inside, workspace = cotangent.new_ones(TILES, PIXELS), Workspace(chunks, channels)
    inputs = chunks, coefficients, channels, background
    checkpoints = composite(*inputs, inside, workspace).checkpoints
    actual = composite_vjp(
        *inputs, checkpoints, cotangent[:, :4].contiguous(), -cotangent[:, 4], workspace
    )
    for ours, leaf in zip(actual, leaves, strict=True):
        assert_gradients_close(ours, leaf.grad, relative=1e-10)
        assert (ours != 0).double().mean() > 0.5  # the test would pass on zeros otherwise

    def varied(value: Tensor) -> Tensor:
        return (composite_plainly(chunks, coefficients, value, background) * cotangent).sum()

    assert_gradients_close(actual[1], numerical_gradient(varied, channels), relative=1e-7)


# Degenerate input


def test_many_opaque_slots_give_finite_gradients():
    chunks = chunks_of(40)
    count = sum(chunk.slots * chunk.tiles for chunk in chunks)
    coefficients = torch.zeros(6, count)
    coefficients[0] = -0.01  # alpha 0.99 everywhere: T falls to 1e-80, below any float32
    inputs = chunks, coefficients, torch.ones(count, 4), torch.zeros(4)
    inside, workspace = torch.ones(TILES, PIXELS), Workspace(chunks, coefficients)
    out = composite(*inputs, inside, workspace)
    v_coefficients, v_channels = composite_vjp(
        *inputs, out.checkpoints, torch.ones(TILES, 4, PIXELS), torch.zeros_like(inside), workspace
    )
    torch.testing.assert_close(out.channels, torch.ones(TILES, 4, PIXELS))
    assert v_coefficients.isfinite().all() and v_channels.isfinite().all()
