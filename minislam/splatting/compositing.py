"""Eq. (1) and (2) on blocks of pixels: what the Gaussians of a tile show, front to back.

A group of B tiles with P pixels each and K slots per tile is one dense block. With the features
f = (red, green, blue, z) of slot k, per pixel

    T_0 = 1,   T_{k+1} = T_k (1 - alpha_k),   out = sum_k T_k alpha_k f_k + T_K f_background.

Three rewritings make it fast without compiled code:
* ln alpha is a quadratic polynomial in the pixel position, so all of them are one matrix product
  of six coefficients per slot with six monomials per pixel.
* Since T_k alpha_k = T_k - T_{k+1}, summation by parts gives out = sum_k T_k (f_k - f_{k-1}) with
  f_{-1} = 0 and f_K = f_background: a matrix product with T itself, no weights are formed.
* Depth is walked in chunks that stay in the cache. Only T at the start of each chunk is kept; the
  backward computes the rest anew, which is as fast as reading it back and needs a tenth of the
  memory. All large arrays are reused: fresh memory costs more than the arithmetic in it.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from minislam.splatting.rendering import MIN_ALPHA
from minislam.splatting.tiles import PIXELS, TILE

CHUNK = 8  # slots per step; two blocks of CHUNK * GROUP * PIXELS float32 fill half of a 2 MB cache


class Scratch:
    """Work space for the largest block, allocated once per image."""

    def __init__(self, tiles: int, like: Tensor) -> None:
        self._buffers = [like.new_empty((CHUNK + 1) * tiles * PIXELS) for _ in range(4)]

    def block(self, number: int, slots: int, tiles: int) -> Tensor:
        """Return buffer `number` as an array (slots, tiles, PIXELS)."""
        return self._buffers[number][: slots * tiles * PIXELS].view(slots, tiles, PIXELS)


class GroupOutput(NamedTuple):
    """What a group of tiles shows."""

    features: Tensor  # (B, 4, P)
    transmittance: Tensor  # (B, P), T_K
    contribution: Tensor  # (K, B), sum of T_k alpha_k over the pixels of a tile
    checkpoints: Tensor  # (ceil(K / CHUNK), B, P), T at the start of each chunk


def monomials(like: Tensor) -> Tensor:
    """Return [1, X, Y, X^2, X Y, Y^2] (6, P) of a tile's pixels, relative to its centre in px."""
    line = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(line, line, indexing="ij"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def exponents(
    offsets: Tensor,  # (2, S) px, mean minus tile centre
    conics: Tensor,  # (3, S) px^-2
    log_opacities: Tensor,  # (S,)
) -> Tensor:  # (6, S)
    """Return the coefficients of ln alpha = ln o - d^T Q d / 2 over the monomials. Eq. (1)."""
    m_x, m_y = offsets
    a, b, c = conics
    p, q = a * m_x + b * m_y, b * m_x + c * m_y  # Q m
    constant = log_opacities - 0.5 * (m_x * p + m_y * q)
    return torch.stack([constant, p, q, -0.5 * a, -b, -0.5 * c])


def exponents_vjp(
    offsets: Tensor,  # (2, S)
    v_exponents: Tensor,  # (6, S)  sums of g, g X, g Y, g X^2, g X Y, g Y^2 over the pixels
) -> Tensor:  # (6, S)  sums of g, g d_x, g d_y, g d_x^2, g d_x d_y, g d_y^2
    """Shift the moments of g = dL/d ln alpha from the tile's centre to the mean, d = X - m.

    The shifted moments are the whole backward of Eq. (1), and add up over the tiles of a
    Gaussian: v_ln_o is the first, v_mu' is Q times the next two, and the conic (a, b, c) gets
    -1/2, -1 and -1/2 times the last three. See `ellipse_vjp`.
    """
    m_x, m_y = offsets
    g, g_x, g_y, g_xx, g_xy, g_yy = v_exponents
    first_x, first_y = g_x - m_x * g, g_y - m_y * g
    second_xx = g_xx - m_x * (g_x + first_x)
    second_xy = g_xy - m_x * g_y - m_y * first_x
    second_yy = g_yy - m_y * (g_y + first_y)
    return torch.stack([g, first_x, first_y, second_xx, second_xy, second_yy])


def ellipse_vjp(
    conics: Tensor,  # (3, N)
    moments: Tensor,  # (6, N) from `exponents_vjp`, summed over the tiles
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
    coefficients: Tensor,  # (6, K * B) from `exponents`, slot-major
    features: Tensor,  # (4, K * B)
    background: Tensor,  # (4,)
    inside: Tensor,  # (B, P) 1 on the image, 0 on pixels beyond its border
    scratch: Scratch,
) -> GroupOutput:
    """Composite a group of tiles from front to back. Eq. (2)."""
    tiles = len(inside)
    slots = coefficients.shape[1] // tiles
    basis = monomials(inside)
    checkpoints = inside.new_empty(-(-slots // CHUNK), tiles, PIXELS)
    checkpoints[0] = inside
    out = inside.new_zeros(tiles, 4, PIXELS)
    contribution = inside.new_empty(slots, tiles)
    features = features.view(4, slots, tiles)
    steps = features.diff(dim=1, prepend=torch.zeros_like(features[:, :1]))  # f_k - f_{k-1}

    for chunk, first in enumerate(range(0, slots, CHUNK)):
        last = min(first + CHUNK, slots)
        _, T = _alphas_and_transmittances(
            coefficients[:, first * tiles : last * tiles], basis, checkpoints[chunk], scratch
        )
        tile_steps = steps[:, first:last].permute(2, 0, 1).contiguous()  # (B, 4, n)
        out.baddbmm_(tile_steps, T[:-1].transpose(0, 1))
        contribution[first:last] = T.sum(2).diff(dim=0).neg_()
        if last < slots:
            checkpoints[chunk + 1] = T[-1]
    out.addcmul_((background[:, None] - features[:, -1]).T[:, :, None], T[-1][:, None])
    return GroupOutput(out, T[-1].clone(), contribution, checkpoints)


def composite_vjp(
    coefficients: Tensor,  # (6, K * B)
    features: Tensor,  # (4, K * B)
    background: Tensor,  # (4,)
    checkpoints: Tensor,  # (ceil(K / CHUNK), B, P)
    v_out: Tensor,  # (B, 4, P)
    v_transmittance: Tensor,  # (B, P)  dL/dT_K
    v_slots: Tensor,  # (10, K * B) out: gradients of the coefficients and of the features
    scratch: Scratch,
) -> None:
    """Pull gradients of a group's pixels back to its slots, from back to front. Eq. (2).

    Let R_k be v_out . (what slot k and all behind it would show if T restarted at 1 there):

        R_K = f_background . v_out + v_T_K,
        R_k = R_{k+1} + alpha_k (f_k . v_out - R_{k+1}),
        dL/d ln alpha_k = T_k (R_k - R_{k+1}),
        dL/df_k = sum over pixels of (T_k - T_{k+1}) v_out.

    Nowhere is anything divided by 1 - alpha.
    """
    tiles = len(v_transmittance)
    slots = coefficients.shape[1] // tiles
    basis = monomials(v_out)
    features = features.view(4, slots, tiles)
    v_coefficients, v_features = v_slots[:6], v_slots[6:].view(4, slots, tiles)
    v_out_t = v_out.transpose(1, 2).contiguous()
    R_behind = (background @ v_out).add_(v_transmittance)

    for chunk in reversed(range(len(checkpoints))):
        first, last = chunk * CHUNK, min((chunk + 1) * CHUNK, slots)
        count, span = last - first, slice(first * tiles, last * tiles)
        alphas, T = _alphas_and_transmittances(
            coefficients[:, span], basis, checkpoints[chunk], scratch
        )
        v_weights = scratch.block(2, count, tiles)  # f_k . v_out
        tile_features = features[:, first:last].permute(2, 1, 0).contiguous()  # (B, n, 4)
        torch.bmm(tile_features, v_out, out=v_weights.transpose(0, 1))
        R = scratch.block(3, count + 1, tiles)
        R[-1] = R_behind
        for k in reversed(range(count)):
            torch.lerp(R[k + 1], v_weights[k], alphas[k], out=R[k])
        R_behind = R[0].clone()

        v_log_alphas = torch.sub(R[:-1], R[1:], out=v_weights).mul_(T[:-1])
        v_coefficients[:, span] = basis @ v_log_alphas.view(-1, PIXELS).T
        shown = torch.bmm(T.transpose(0, 1), v_out_t)  # (B, count + 1, 4)
        v_features[:, first:last] = (shown[:, :-1] - shown[:, 1:]).permute(2, 1, 0)


def _alphas_and_transmittances(
    coefficients: Tensor,  # (6, n * B)
    basis: Tensor,  # (6, P)
    T_first: Tensor,  # (B, P)
    scratch: Scratch,
) -> tuple[Tensor, Tensor]:  # (n, B, P), (n + 1, B, P)
    """Return alpha of n slots and T before, between and after them."""
    tiles = len(T_first)
    count = coefficients.shape[1] // tiles
    alphas, T = scratch.block(0, count, tiles), scratch.block(1, count + 1, tiles)
    # 2^(x log2 e), because exp is forty times slower than exp2 where its result underflows.
    torch.mm(coefficients.T, basis * math.log2(math.e), out=alphas.view(-1, PIXELS))
    torch.nn.functional.threshold_(alphas.exp2_(), MIN_ALPHA, 0.0)
    T[0] = T_first
    for k in range(count):
        torch.addcmul(T[k], T[k], alphas[k], value=-1, out=T[k + 1])
    return alphas, T
