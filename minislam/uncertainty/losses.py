"""The terms of L_uncer, which trains the MLP and nothing else (Sec. 3.2).

Everything that comes from the renderer is a constant here: L_uncer never moves a Gaussian.
"""

import torch
from torch import Tensor
from torch.nn import functional

from minislam.images import SSIM_C1, SSIM_C2, local_moments
from minislam.uncertainty.config import UncertaintyConfig
from minislam.uncertainty.weights import clipped_beta

SSIM_WINDOW = 7  # px, official; NeRF On-the-go uses a 5x5 box
SSIM_C3 = SSIM_C2 / 2  # the usual choice, with which l c s is the classic SSIM
STRUCTURE_CAP = 0.98  # of c and s: one perfect factor must not hide the two others
SURFACE_OPACITY = 0.9  # a rendering less opaque than this shows a hole, not a surface, official
FAR_FACTOR = 10.0  # median depths: farther reference depths are not used, official: nor beyond 50 m


def ssim_components(
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    rendered: Tensor,  # (H, W, 3)
) -> tuple[Tensor, Tensor, Tensor]:  # 3 x (H, W)
    """Return luminance l, contrast c and structure s of the modified SSIM, means over channels.

    l = (2 m1 m2 + C1) / (m1^2 + m2^2 + C1),  c = (2 d1 d2 + C2) / (d1^2 + d2^2 + C2) and
    s = (d12 + C3) / (d1 d2 + C3), with local means m, deviations d and covariance d12.
    """
    first, second = image.permute(2, 0, 1), rendered.permute(2, 0, 1)
    m1, m11, m12, m2, m22 = local_moments(first, second, SSIM_WINDOW)

    # E[x^2] - E[x]^2 can come out negative, and |d12| larger than d1 d2, by round-off.
    smallest = torch.finfo(image.dtype).eps
    d1 = (m11 - m1 * m1).clamp_min(smallest).sqrt()
    d2 = (m22 - m2 * m2).clamp_min(smallest).sqrt()
    d12 = (m12 - m1 * m2).clamp(-d1 * d2, d1 * d2)

    luminance = (2 * m1 * m2 + SSIM_C1) / (m1 * m1 + m2 * m2 + SSIM_C1)
    contrast = (2 * d1 * d2 + SSIM_C2) / (d1 * d1 + d2 * d2 + SSIM_C2)
    structure = (d12 + SSIM_C3) / (d1 * d2 + SSIM_C3)
    contrast, structure = contrast.clamp_max(STRUCTURE_CAP), structure.clamp_max(STRUCTURE_CAP)
    return luminance.mean(0), contrast.mean(0), structure.mean(0)


def modified_ssim_loss(
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    rendered: Tensor,  # (H, W, 3)
    opacity: Tensor,  # (H, W) in [0, 1]
    config: UncertaintyConfig,
) -> Tensor:  # (H, W) in [0, config.loss_cap]
    """Return L'_SSIM = gain (1 - l)(1 - c)(1 - s) per pixel, faded where nothing is rendered.

    The product is far steeper than 1 - SSIM: near 0 for small rendering errors, large where the
    image shows another object. It is the first term of L_uncer's numerator.
    """
    luminance, contrast, structure = ssim_components(image, rendered)
    product = (1 - luminance) * (1 - contrast) * (1 - structure)
    return (opacity * config.ssim_gain * product).clamp(0, config.loss_cap)


def depth_loss(
    rendered_depth: Tensor,  # (H, W) world units
    reference_depth: Tensor,  # (H, W) world units, 0 where unknown
    far_limit: float,  # world units; a reference beyond it is not used
) -> Tensor:  # (H, W) world units
    """Return |D^ - D~| per pixel, 0 where the reference depth is unknown or far. Eq. (3)."""
    known = (reference_depth > 0) & (reference_depth < far_limit)
    return torch.where(known, (rendered_depth - reference_depth).abs(), 0)


def median_filter(values: Tensor, size: int) -> Tensor:  # both (h, w)
    """Return the median over windows of size x size cells (odd), mirrored at the border."""
    # It removes thin lines of error: an edge rendered half a pixel off is not a dynamic object.
    margin = min(size // 2, values.shape[0] - 1, values.shape[1] - 1)
    size = 2 * margin + 1
    padded = functional.pad(values[None, None], [margin] * 4, mode="reflect")[0, 0]
    windows = padded.unfold(0, size, 1).unfold(1, size, 1)
    return windows.reshape(*values.shape, size * size).median(-1).values


def variance_regulariser(
    beta_raw: Tensor,  # (n,) unclipped, so that cells under the floor get a gradient too
    features: Tensor,  # (n, C)
    config: UncertaintyConfig,
) -> Tensor:  # ()
    """Return L_reg_V, the mean variance of beta among cells of similar features.

    Each cell is compared with itself and those whose cosine exceeds `similarity`: at most the
    `neighbours` most similar ones, and what ties with the last of them.
    """
    unit = functional.normalize(features.detach(), dim=-1)
    cosine = unit @ unit.T
    # A cell is always similar to itself, even when its feature vector is zero.
    cosine.fill_diagonal_(torch.inf)
    similar = cosine > config.similarity
    crowded = similar.sum(-1) > config.neighbours
    if crowded.any():
        most_similar = cosine[crowded].topk(config.neighbours, dim=-1, sorted=False).values
        similar[crowded] &= cosine[crowded] >= most_similar.amin(-1, keepdim=True)
    similar = similar.to(beta_raw)
    number = similar.sum(-1)
    mean = similar @ beta_raw / number
    variance = (similar * (beta_raw - mean[:, None]) ** 2).sum(-1) / number
    return variance.mean()


def cell_loss(
    beta_raw: Tensor,  # (h', w') with gradient to the MLP
    error: Tensor,  # (h', w') L'_SSIM + lambda_1 L_depth, constant
    opacity: Tensor,  # (h', w') in [0, 1]
    config: UncertaintyConfig,
) -> Tensor:  # (h', w')
    """Return (L'_SSIM + lambda_1 L_depth) / beta^2 + lambda_3 log beta per cell, of Eq. (4).

    Without L_reg_U = log beta an infinite beta would be the minimum. With lambda_3 = 0.5 and error
    L it is at beta = 2 sqrt(L). Cells not covered yet give 0: a hole is not a dynamic object.
    """
    beta = clipped_beta(beta_raw)
    loss = error.detach() / beta**2 + config.lambda_log * beta.log()
    return torch.where(opacity >= SURFACE_OPACITY, loss, 0)
