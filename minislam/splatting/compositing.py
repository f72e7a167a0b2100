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

CHUNK = 12  # slots per step: longer steps leave a 2 MB cache, shorter ones cost more calls


class Workspace:
    """What all groups of an image share: the monomials, and buffers for the largest block."""

    def __init__(self, tiles: int, like: Tensor) -> None:
        self._buffers = [like.new_empty((CHUNK + 1) * tiles * PIXELS) for _ in range(4)]
        self.monomials = monomials(like)  # (6, P)
        # 2^(x log2 e), because exp is forty times slower than exp2 where its result underflows.
        self.monomials_log2 = self.monomials * math.log2(math.e)

    def block(self, number: int, rows: int, columns: int) -> Tensor:
        """Return buffer `number` as an array (rows, columns, PIXELS)."""
        return self._buffers[number][: rows * columns * PIXELS].view(rows, columns, PIXELS)


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
    features: Tensor,  # (B, K, 4)
    background: Tensor,  # (4,)
    inside: Tensor,  # (B, P) 1 on the image, 0 on pixels beyond its border
    workspace: Workspace,
) -> GroupOutput:
    """Composite a group of tiles from front to back. Eq. (2)."""
    tiles, slots, _ = features.shape
    checkpoints = inside.new_empty(-(-slots // CHUNK), tiles, PIXELS)
    checkpoints[0] = inside  # T = 0 beyond the border: nothing is shown or counted there
    out = inside.new_zeros(tiles, 4, PIXELS)
    light = inside.new_empty(slots + 1, tiles)  # T_k summed over the pixels of a tile
    steps = features.diff(dim=1, prepend=torch.zeros_like(features[:, :1]))  # f_k - f_{k-1}

    for chunk, first in enumerate(range(0, slots, CHUNK)):
        last = min(first + CHUNK, slots)
        span = slice(first * tiles, last * tiles)
        _, T = _alphas_and_transmittances(coefficients[:, span], checkpoints[chunk], workspace)
        out.baddbmm_(steps[:, first:last].transpose(1, 2), T[:-1].transpose(0, 1))
        torch.sum(T, 2, out=light[first : last + 1])
        if last < slots:
            checkpoints[chunk + 1] = T[-1]
    transmittance = T[-1].clone()
    out.addcmul_((background - features[:, -1])[:, :, None], transmittance[:, None])
    return GroupOutput(out, transmittance, light[:-1] - light[1:], checkpoints)


def composite_vjp(
    coefficients: Tensor,  # (6, K * B)
    features: Tensor,  # (B, K, 4)
    background: Tensor,  # (4,)
    checkpoints: Tensor,  # (ceil(K / CHUNK), B, P)
    v_out: Tensor,  # (B, 4, P)
    v_transmittance: Tensor,  # (B, P)  dL/dT_K
    workspace: Workspace,
) -> tuple[Tensor, Tensor]:  # (6, K * B), (B, K, 4)
    """Pull gradients of a group's pixels back to coefficients and features. Eq. (2).

    From back to front, let R_k be v_out . (what slot k and all behind it would show if T
    restarted at 1 there):

        R_K = f_background . v_out + v_T_K,
        R_k = R_{k+1} + alpha_k (f_k . v_out - R_{k+1}),
        dL/d ln alpha_k = T_k (R_k - R_{k+1}),
        dL/df_k = sum over pixels of (T_k - T_{k+1}) v_out.

    Nowhere is anything divided by 1 - alpha.
    """
    tiles, slots, _ = features.shape
    v_coefficients = torch.empty_like(coefficients)
    v_features = torch.empty_like(features)
    v_out_t = v_out.transpose(1, 2).contiguous()
    R_behind = (background @ v_out).add_(v_transmittance)

    for chunk in reversed(range(len(checkpoints))):
        first, last = chunk * CHUNK, min((chunk + 1) * CHUNK, slots)
        count, span = last - first, slice(first * tiles, last * tiles)
        alphas, T = _alphas_and_transmittances(coefficients[:, span], checkpoints[chunk], workspace)
        v_weights = workspace.block(2, tiles, count)  # f_k . v_out; bmm cannot fill (n, B, P)
        torch.bmm(features[:, first:last], v_out, out=v_weights)
        R = workspace.block(3, count + 1, tiles)
        R[-1] = R_behind
        R_k, v_weights_k, alphas_k = R.unbind(0), v_weights.unbind(1), alphas.unbind(0)
        for k in reversed(range(count)):
            torch.lerp(R_k[k + 1], v_weights_k[k], alphas_k[k], out=R_k[k])
        R_behind = R[0].clone()

        v_log_alphas = torch.sub(R[:-1], R[1:], out=alphas).mul_(T[:-1])
        v_coefficients[:, span] = workspace.monomials @ v_log_alphas.view(-1, PIXELS).T
        shown = torch.bmm(T.transpose(0, 1), v_out_t)  # (B, n + 1, 4)
        torch.sub(shown[:, :-1], shown[:, 1:], out=v_features[:, first:last])
    return v_coefficients, v_features


def _alphas_and_transmittances(
    coefficients: Tensor,  # (6, n * B)
    T_first: Tensor,  # (B, P)
    workspace: Workspace,
) -> tuple[Tensor, Tensor]:  # (n, B, P), (n + 1, B, P)
    """Return alpha of n slots and T before, between and after them."""
    tiles = len(T_first)
    count = coefficients.shape[1] // tiles
    alphas, T = workspace.block(0, count, tiles), workspace.block(1, count + 1, tiles)
    torch.mm(coefficients.T, workspace.monomials_log2, out=alphas.view(-1, PIXELS))
    torch.nn.functional.threshold_(alphas.exp2_(), MIN_ALPHA, 0.0)
    T[0] = T_first
    T_k, alphas_k = T.unbind(0), alphas.unbind(0)  # once: to index makes a view every time
    for k in range(count):
        torch.addcmul(T_k[k], T_k[k], alphas_k[k], value=-1, out=T_k[k + 1])
    return alphas, T
