"""Images and grids: Gaussian blur, the constants and moments of SSIM, resampling and shrinking."""

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

SSIM_SIGMA = 1.5  # px, standard deviation of the window (Wang et al. 2004)
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # keep flat patches of images in [0, 1] from 0/0 (the same)
_STRIP = 32  # px blurred by one matrix product: wider ones multiply more zeros (measured)


def local_moments(x: Tensor, y: Tensor, size: int) -> Tensor:  # both (C, H, W) -> (5, C, H, W)
    """Return the local means of x, x^2, x y, y and y^2 under SSIM's window of `size` px, odd."""
    return gaussian_blur(torch.stack([x, x * x, x * y, y, y * y]), size, SSIM_SIGMA)


def gaussian_blur(images: Tensor, size: int, sigma: float) -> Tensor:  # both (..., H, W)
    """Blur by a normalised Gaussian window of odd `size` and `sigma` [px], zero beyond it."""
    # It is B_rows @ image @ B_columns. On a CPU, strips of these banded matrices are far faster
    # than a convolution of a few channels, and three times as fast as the whole matrices.
    height, width = images.shape[-2:]
    kind = size, sigma, images.dtype, images.device
    wide = torch.cat([images[..., seen] @ B for seen, B in _blur_strips(width, *kind)], -1)
    return torch.cat([B.T @ wide[..., seen, :] for seen, B in _blur_strips(height, *kind)], -2)


@lru_cache(maxsize=16)
def _blur_strips(
    length: int, size: int, sigma: float, dtype: torch.dtype, device: torch.device
) -> list[tuple[slice, Tensor]]:
    """Return the banded matrix that blurs a row, as strips of columns, and what each reads [px]."""
    position = torch.arange(length, dtype=dtype, device=device)
    reach = size // 2
    window = torch.arange(size, dtype=dtype, device=device) - reach
    total = torch.exp(-0.5 * (window / sigma) ** 2).sum()
    strips = []
    for first in range(0, length, _STRIP):
        seen = slice(max(first - reach, 0), first + _STRIP + reach)
        distance = (position[seen, None] - position[None, first : first + _STRIP]).abs()
        blur = torch.exp(-0.5 * (distance / sigma) ** 2) * (distance <= reach) / total
        strips.append((seen, blur))
    return strips


def resample(values: Tensor, height: int, width: int) -> Tensor:  # (h, w) -> (height, width)
    """Interpolate a grid bilinearly at the cell centres of another one over the same area.

    Both cover the image evenly: of w' columns on W px, the centre of column j lies at
    (j + 0.5) W / w' - 0.5. Nothing is smoothed before a resampling to fewer cells.
    """
    return functional.interpolate(values[None, None], (height, width), mode="bilinear")[0, 0]


def shrink_image(image: Tensor, height: int, width: int) -> Tensor:
    """Return the image (height, width, 3) whose pixels are means over the areas they cover."""
    if image.shape[:2] == (height, width):
        return image
    return _area_mean(image.permute(2, 0, 1), height, width).permute(1, 2, 0).contiguous()


def shrink_depth(depth: Tensor, height: int, width: int) -> Tensor:
    """Return the depth (height, width) of means over the KNOWN pixels, 0 where there are none."""
    if depth.shape == (height, width):
        return depth
    known = (depth > 0).to(depth)
    total, fraction = _area_mean(torch.stack([depth * known, known]), height, width)
    smallest = torch.finfo(depth.dtype).eps  # where no pixel is known, 0 / 0 is not taken
    return torch.where(fraction > 0, total / fraction.clamp_min(smallest), 0)


def _area_mean(channels: Tensor, height: int, width: int) -> Tensor:  # (C, H, W)
    down, across = channels.shape[1] // height, channels.shape[2] // width
    if channels.shape[1:] != (down * height, across * width):
        return functional.adaptive_avg_pool2d(channels[None], (height, width))[0]
    # A third of the time: each area has the same number of pixels.
    parts = [channels[:, y::down, x::across] for y in range(down) for x in range(across)]
    return sum(parts[1:], parts[0]) / len(parts)
