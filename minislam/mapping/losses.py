"""The terms of L_render, which moves the Gaussians and nothing else (Sec. 3.4)."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from minislam.images import SSIM_C1, SSIM_C2, SSIM_SIGMA, gaussian_blur, local_moments
from minislam.mapping.config import MappingConfig
from minislam.splatting import GaussianMap, Rendering
from minislam.uncertainty.losses import FAR_FACTOR, SURFACE_OPACITY, depth_loss

SSIM_WINDOW = 11  # px, the usual window of SSIM, as in 3DGS
BLACK = 0.01  # summed RGB; darker pixels are the border that undistortion leaves, official
METRIC_MEDIAN = 2.0  # m, our assumption: median depth of a scene that the official constants fit
FLOATER_MARGIN = 0.5  # median depths between a floater and the reference behind it


def metre(median_depth: float) -> float:
    """Return the world units that replace one metre of the official constants."""
    return median_depth / METRIC_MEDIAN


def ssim_loss(rendered: Tensor, image: Tensor) -> Tensor:  # both (H, W, 3) -> (H, W) in [0, 2]
    """Return 1 - SSIM of each pixel, mean over RGB in [0, 1]; the image is a constant."""
    return _SsimLoss.apply(rendered, image)


class _SsimLoss(torch.autograd.Function):
    """The loss above and its backward. Autograd would store several times as many maps."""

    @staticmethod
    def forward(ctx, rendered: Tensor, image: Tensor) -> Tensor:
        x, y = (picture.permute(2, 0, 1).contiguous() for picture in (rendered, image))
        ssim, slopes = ssim_of_moments(*local_moments(x, y, SSIM_WINDOW))
        ctx.save_for_backward(x, y, slopes)
        return 1 - ssim.mean(0)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_loss: Tensor) -> tuple[Tensor, None]:  # (H, W) -> (H, W, 3)
        x, y, slopes = ctx.saved_tensors
        # The window is symmetric: a blur is its own transpose.
        v_means = slopes * (v_loss / -len(x))
        v_mean_x, v_mean_xx, v_mean_xy = gaussian_blur(v_means, SSIM_WINDOW, SSIM_SIGMA)
        v_x = v_mean_x + 2 * x * v_mean_xx + y * v_mean_xy
        return v_x.permute(1, 2, 0), None


def ssim_of_moments(
    mean_x: Tensor,  # (3, H, W) local means of x,
    mean_xx: Tensor,  # x^2,
    mean_xy: Tensor,  # x y,
    mean_y: Tensor,  # y
    mean_yy: Tensor,  # and y^2
) -> tuple[Tensor, Tensor]:  # (3, H, W), (3, 3, H, W)
    """Return the SSIM and its derivatives by the first three means.

    The SSIM is A B / (C D) with

        A = 2 m_x m_y + C1,            B = 2 (m_xy - m_x m_y) + C2,
        C = m_x^2 + m_y^2 + C1,        D = m_xx - m_x^2 + m_yy - m_y^2 + C2,

    so dS/dm_xx = -S / D, dS/dm_xy = 2 A / (C D) and
    dS/dm_x = 2 m_y (B - A) / (C D) - 2 m_x S (1 / C - 1 / D).
    """
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    A, B = 2 * product + SSIM_C1, 2 * (mean_xy - product) + SSIM_C2
    C, D = squares + SSIM_C1, mean_xx + mean_yy - squares + SSIM_C2
    inverse = 1 / (C * D)
    ssim = A * B * inverse
    by_mean = 2 * inverse * (mean_y * (B - A) - mean_x * ssim * (D - C))
    return ssim, torch.stack([by_mean, -ssim / D, 2 * A * inverse])


def color_loss(
    rendered: Tensor,  # (H, W, 3)
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    lambda_ssim: float,  # weight of SSIM in [0, 1]
) -> Tensor:  # (H, W)
    """Return (1 - lambda) |I^ - I| + lambda (1 - SSIM), mean over RGB, 0 where black. Eq. (7)."""
    absolute = (rendered - image).abs().mean(-1)
    loss = (1 - lambda_ssim) * absolute
    if lambda_ssim > 0:
        loss = loss + lambda_ssim * ssim_loss(rendered, image)
    return torch.where(image.sum(-1) > BLACK, loss, 0)


def weighted_depth_loss(
    rendered_depth: Tensor,  # (H, W) world units
    opacity: Tensor,  # (H, W) in [0, 1]
    reference_depth: Tensor,  # (H, W) world units, 0 where unknown
    weight: Tensor,  # (H, W) static weight
    far_limit: float,  # world units
    floater_margin: float,  # world units
) -> Tensor:  # (H, W) world units
    """Return the weighted |D^ - D~|; the loss of floaters is not weighted.

    A floater is a Gaussian surface far in front of the reference depth. A high beta is no reason
    to keep it, because a dynamic object makes the reference too near, never too far. The test of
    opacity excludes holes in the map: their rendered depth is small too, but with this loss the
    depth of the dynamic object in front of a hole would fill it.
    """
    loss = depth_loss(rendered_depth, reference_depth, far_limit)
    in_front = reference_depth > rendered_depth.detach() + floater_margin
    floater = in_front & (opacity.detach() > SURFACE_OPACITY)
    return torch.where(floater, loss, weight * loss)


def isotropic_loss(scales: Tensor) -> Tensor:
    """Return the mean over Gaussians and axes of |s - mean_axis(s)|, of scales (N, 3)."""
    return (scales - scales.mean(-1, keepdim=True)).abs().mean()


def render_loss(
    gaussians: GaussianMap,
    rendering: Rendering,
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    reference_depth: Tensor,  # (H, W) world units, 0 where unknown
    weight: Tensor,  # (H, W) static weight 0.5 / beta^2, without gradient
    median_depth: float,  # world units, of the scene
    config: MappingConfig,
) -> tuple[Tensor, Tensor]:  # (), () with the weighted mean of L_color
    """Return (lambda_5 L_color + lambda_6 L_depth) / beta^2 + lambda_7 L_iso. Eq. (6).

    Means run over all pixels. The factor 1/2 of lambda_5 and lambda_6 is in the weight.
    """
    unit = metre(median_depth)
    color = (weight * color_loss(rendering.color, image, config.lambda_ssim)).mean()
    depths = rendering.depth, rendering.opacity, reference_depth
    limits = FAR_FACTOR * median_depth, FLOATER_MARGIN * median_depth
    depth = weighted_depth_loss(*depths, weight, *limits).mean() / unit
    isotropic = isotropic_loss(gaussians.scales) / unit
    total = config.color_weight * color + (1 - config.color_weight) * depth
    return total + config.lambda_isotropic * isotropic, color
