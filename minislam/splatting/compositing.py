"""Eq. (1) and Eq. (2) for a group of tiles: colour and depth of each pixel, front to back.

A group has B tiles with P pixels each, a tile has K slots, and a slot holds one Gaussian. With the
channels f_k = (red, green, blue, z) of slot k, per pixel

    T_0 = 1,   T_{k+1} = T_k (1 - alpha_k),   out = sum_k T_k alpha_k f_k + T_K f_background.

Three rewritings make it fast without compiled code:
* ln alpha is a quadratic polynomial in the pixel position, so one matrix product of six
  coefficients per slot with six monomials per pixel gives all of them.
* Since T_k alpha_k = T_k - T_{k+1}, summation by parts gives out = sum_k T_k (f_k - f_{k-1}) with
  f_{-1} = 0 and f_K = f_background: a matrix product with T itself, without blending weights.
* The slots are processed in chunks that stay in the cache, each without the tiles whose lists have
  ended. Only T at the start of a chunk is kept; the backward computes the rest anew, which is as
  fast as reading it back and needs a tenth of the memory. All large arrays are reused: fresh
  memory costs more than the arithmetic in it.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from minislam.splatting.constants import MIN_ALPHA
from minislam.splatting.tiles import PIXELS, TILE, Chunk

_T, _ALPHAS, _V_WEIGHTS = range(3)  # the buffers of a workspace


class Block(NamedTuple):
    """A number per slot, tile and pixel."""

    all: Tensor  # (n, B, P)
    slots: tuple[Tensor, ...]  # the same, n times (B, P)


class Workspace:
    """Shared by all groups of an image: the monomials, and buffers for the largest block."""

    def __init__(self, chunks: Iterable[Chunk], like: Tensor) -> None:
        self.monomials = monomials(like)  # (6, P)
        # 2^(x log2 e), because exp is forty times slower than exp2 where its result underflows.
        self.monomials_log2 = self.monomials * math.log2(math.e)
        largest = max(((slots + 1) * tiles for slots, tiles in chunks), default=0)
        self._buffers = like.new_empty(3, largest * PIXELS)
        self._blocks: dict[tuple[int, ...], Block] = {}

    def block(self, number: int, slots: int, tiles: int, tile_major: bool = False) -> Block:
        """Return buffer `number` as a block; `tile_major` is the order of its memory."""
        key = number, slots, tiles
        # Kept for the next chunk: cutting it into slots takes as long as the arithmetic on two.
        if key not in self._blocks:
            flat = self._buffers[number, : slots * tiles * PIXELS]
            by_tile = flat.view(tiles, slots, PIXELS).transpose(0, 1)
            values = by_tile if tile_major else flat.view(slots, tiles, PIXELS)
            self._blocks[key] = Block(values, values.unbind(0))
        return self._blocks[key]


class GroupOutput(NamedTuple):
    """A composited group of tiles."""

    channels: Tensor  # (B, 4, P)
    transmittance: Tensor  # (B, P), T_K
    weight_sums: Tensor  # (S,), blending weight T_k alpha_k summed over the pixels of a tile
    checkpoints: list[Tensor]  # (b, P), T at the start of each chunk, of its b tiles


def monomials(like: Tensor) -> Tensor:
    """Return [1, X, Y, X^2, X Y, Y^2] (6, P) of a tile's pixels, relative to its centre in px."""
    line = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(line, line, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def log_alpha_coefficients(
    offsets: Tensor,  # (2, S) px, mean minus tile centre
    conics: Tensor,  # (3, S) px^-2
    log_opacities: Tensor,  # (S,)
) -> Tensor:  # (6, S)
    """Return the coefficients of ln alpha = ln o - d^T Q d / 2 for 1, x, y, x^2, x y, y^2.

    (x, y) is the pixel minus the tile centre. Slow twin: reference.gaussian_alphas. Eq. (1).
    """
    m_x, m_y = offsets
    a, b, c = conics
    p, q = torch.addcmul(a * m_x, b, m_y), torch.addcmul(b * m_x, c, m_y)  # Q m
    constant = log_opacities.addcmul(m_x, p, value=-0.5).addcmul_(m_y, q, value=-0.5)
    return torch.stack([constant, p, q, -0.5 * a, -b, -0.5 * c])


def log_alpha_coefficients_vjp(
    offsets: Tensor,  # (2, S)
    v_coefficients: Tensor,  # (6, S)  sums of g, g X, g Y, g X^2, g X Y, g Y^2 over the pixels
) -> Tensor:  # (6, S)  sums of g, g d_x, g d_y, g d_x^2, g d_x d_y, g d_y^2
    """Shift the moments of g = dL/d ln alpha from the tile's centre to the mean, d = X - m.

    The shifted moments may be summed over the tiles of a Gaussian, and `moments_vjp` turns the
    sums into gradients: together they are the whole backward of Eq. (1).
    """
    m_x, m_y = offsets
    moments = v_coefficients.clone()  # then in place, which takes half the time
    g, g_x, g_y, g_xx, g_xy, g_yy = moments
    # X^2 to d_x X, X Y to d_x Y, Y^2 to d_y Y
    g_xx.addcmul_(m_x, g_x, value=-1)
    g_xy.addcmul_(m_x, g_y, value=-1)
    g_yy.addcmul_(m_y, g_y, value=-1)
    # X to d_x, Y to d_y
    g_x.addcmul_(m_x, g, value=-1)
    g_y.addcmul_(m_y, g, value=-1)
    # d_x X to d_x^2, d_x Y to d_x d_y, d_y Y to d_y^2
    g_xx.addcmul_(m_x, g_x, value=-1)
    g_xy.addcmul_(m_y, g_x, value=-1)
    g_yy.addcmul_(m_y, g_y, value=-1)
    return moments


def moments_vjp(
    conics: Tensor,  # (3, N)
    moments: Tensor,  # (6, N) from `log_alpha_coefficients_vjp`, summed over the tiles
) -> tuple[Tensor, Tensor, Tensor]:  # (N,), (2, N), (3, N)
    """Return the gradients of ln o, of the projected mean and of the conic. Eq. (1).

    From ln alpha = ln o - d^T Q d / 2 with d = pixel - mu': d/d mu' = Q d, d/da = -d_x^2 / 2,
    d/db = -d_x d_y, d/dc = -d_y^2 / 2.
    """
    a, b, c = conics
    _, first_x, first_y, second_xx, second_xy, second_yy = moments
    v_means2d = torch.stack([a * first_x + b * first_y, b * first_x + c * first_y])
    return moments[0], v_means2d, torch.stack([-0.5 * second_xx, -second_xy, -0.5 * second_yy])


def composite(
    chunks: list[Chunk],  # S slots in all
    coefficients: Tensor,  # (6, S) from `log_alpha_coefficients`
    channels: Tensor,  # (S, 4)
    background: Tensor,  # (4,)
    inside: Tensor,  # (B, P) 1 on the image, 0 on pixels beyond its border
    workspace: Workspace,
) -> GroupOutput:
    """Composite a group of tiles from front to back. Slow twin: reference.composite. Eq. (2)."""
    transmittance = inside.clone()  # T = 0 beyond the border: nothing is shown or counted there
    out = inside.new_zeros(len(inside), 4, PIXELS)
    f_before = channels.new_zeros(len(inside), 4)  # f_{k-1}
    checkpoints, weight_sums = [], []

    sizes = [slots * tiles for slots, tiles in chunks]
    parts = zip(chunks, coefficients.split(sizes, 1), channels.split(sizes), strict=True)
    for (slots, tiles), chunk_coefficients, f in parts:
        f = f.view(slots, tiles, 4)
        T, T_before = workspace.block(_T, slots + 1, tiles), transmittance[-tiles:]
        checkpoints.append(T_before.clone())
        T.slots[0].copy_(T_before)
        # alpha_k is stored in the place of T_{k+1}: half the memory, so more stays in the cache.
        _gaussian_alphas(chunk_coefficients, workspace, out=T.all[1:])
        _transmittances(T, T.slots[1:])
        steps = f.diff(dim=0, prepend=f_before[None, -tiles:])  # f_k - f_{k-1}
        out[-tiles:].baddbmm_(steps.permute(1, 2, 0), T.all[:-1].transpose(0, 1))
        T_sums = T.all.sum(2)
        weight_sums.append((T_sums[:-1] - T_sums[1:]).view(-1))
        T_before.copy_(T.slots[-1])
        f_before[-tiles:] = f[-1]
    out.addcmul_((background - f_before)[:, :, None], transmittance[:, None])
    return GroupOutput(out, transmittance, torch.cat(weight_sums), checkpoints)


def composite_vjp(
    chunks: list[Chunk],
    coefficients: Tensor,  # (6, S)
    channels: Tensor,  # (S, 4)
    background: Tensor,  # (4,)
    checkpoints: list[Tensor],  # (b, P) of each chunk
    v_out: Tensor,  # (B, 4, P)
    v_transmittance: Tensor,  # (B, P)  dL/dT_K
    workspace: Workspace,
) -> tuple[Tensor, Tensor]:  # (6, S), (S, 4)
    """Pull gradients of a group's pixels back to coefficients and channels. Eq. (2).

    From back to front, let A_k be v_out . (what slots k to K would show with none before them):

        A_K = f_background . v_out + v_T_K,
        A_k = A_{k+1} + g_k,   g_k = alpha_k (f_k . v_out - A_{k+1}),
        dL/d ln alpha_k = T_k g_k,
        dL/df_k = sum over pixels of (T_k - T_{k+1}) v_out.

    Nothing is divided by 1 - alpha, which may be tiny.
    """
    v_coefficients, v_channels = torch.empty_like(coefficients), torch.empty_like(channels)
    v_out_t = v_out.transpose(1, 2).contiguous()
    A = (background[:, None] * v_out).sum(1).add_(v_transmittance)
    gains = torch.empty_like(A)

    sizes = [slots * tiles for slots, tiles in chunks]
    parts = (
        chunks, coefficients.split(sizes, 1), channels.split(sizes), checkpoints,
        v_coefficients.split(sizes, 1), v_channels.split(sizes),
    )  # fmt: skip
    for part in list(zip(*parts, strict=True))[::-1]:
        (slots, tiles), chunk_coefficients, f, T_before, v_chunk_coefficients, v_f = part
        f, v_f = f.view(slots, tiles, 4), v_f.view(slots, tiles, 4)
        T = workspace.block(_T, slots + 1, tiles)
        alphas = workspace.block(_ALPHAS, slots, tiles)
        v_weights = workspace.block(_V_WEIGHTS, slots, tiles, tile_major=True)

        T.slots[0].copy_(T_before)
        _gaussian_alphas(chunk_coefficients, workspace, out=alphas.all)
        _transmittances(T, alphas.slots)
        T_v_sums = torch.bmm(T.all.transpose(0, 1), v_out_t[-tiles:])  # summed over pixels
        torch.sub(T_v_sums[:, :-1], T_v_sums[:, 1:], out=v_f.transpose(0, 1))
        # f_k . v_out, in memory tile by tile because bmm fills no other order.
        torch.bmm(f.transpose(0, 1), v_out[-tiles:], out=v_weights.all.transpose(0, 1))
        A_k, gain = A[-tiles:], gains[-tiles:]  # gain: slot k instead of what it hides
        for v_weight, alpha in zip(v_weights.slots[::-1], alphas.slots[::-1], strict=True):
            torch.sub(v_weight, A_k, out=gain)
            A_k.add_(alpha.mul_(gain))  # alpha_k is not needed again: g_k takes its place
        T_g = alphas.all.mul_(T.all[:-1]).view(-1, PIXELS)
        torch.mm(workspace.monomials, T_g.T, out=v_chunk_coefficients)
    return v_coefficients, v_channels


def _gaussian_alphas(coefficients: Tensor, workspace: Workspace, out: Tensor) -> None:
    """Evaluate alpha (n, B, P) of n slots by their coefficients (6, n * B)."""
    torch.mm(coefficients.T, workspace.monomials_log2, out=out.view(-1, PIXELS))
    torch.nn.functional.threshold(out.exp2_(), MIN_ALPHA, 0.0, inplace=True)


def _transmittances(T: Block, alphas: tuple[Tensor, ...]) -> None:
    """Fill in T (n + 1, B, P) between and after n slots, by their alphas (B, P) and its first."""
    for T_k, alpha, T_next in zip(T.slots[:-1], alphas, T.slots[1:], strict=True):
        torch.addcmul(T_k, T_k, alpha, value=-1, out=T_next)
