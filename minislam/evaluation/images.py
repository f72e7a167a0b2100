"""Measures over pixels: PSNR and SSIM of images, L1 of depths, AUROC of the uncertainty.

LPIPS is in lpips.py. SSIM is written here once more on purpose and shares nothing with
minislam/images.py: a mistake there would be optimised as a loss, and the metric must not repeat it.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from minislam.errors import require

# Wang et al. 2004: an 11x11 Gaussian window, and constants that keep flat areas from 0/0.
_SSIM_RADIUS, _SSIM_SIGMA = 5, 1.5  # px
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2  # for values in [0, 1]


def psnr(
    image: ArrayLike,  # (H, W, 3) or (H, W) in [0, 1]
    reference: ArrayLike,  # the same shape
    mask: ArrayLike | None = None,  # (H, W) bool, True where pixels count; None: everywhere
) -> float:  # dB, infinite for equal images
    """Return the peak signal-to-noise ratio, -10 log10 of the mean squared difference."""
    image, reference = checked_images(image, reference)
    squared = (image - reference) ** 2
    if mask is not None:
        mask = np.asarray(mask, dtype=bool)
        assert mask.shape == squared.shape[:2] and mask.any(), (mask.shape, squared.shape)
        squared = squared[mask]
    error = float(squared.mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(image: ArrayLike, reference: ArrayLike) -> float:  # both (H, W, 3) or (H, W) in [0, 1]
    """Return the mean structural similarity, at most 1, over all windows inside the image."""
    x, y = checked_images(image, reference)
    assert min(x.shape[:2]) > 2 * _SSIM_RADIUS, x.shape
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _SSIM_C1) / (mean_x**2 + mean_y**2 + _SSIM_C1)
    structure = (2 * covariance + _SSIM_C2) / (variance_x + variance_y + _SSIM_C2)
    return float((luminance * structure).mean())


def depth_l1(
    depth: ArrayLike,  # (H, W) world units of the map, 0 where unknown
    reference: ArrayLike,  # (H, W) world units of the truth, 0 where unknown
    scale: float,  # units of the truth per unit of the map, from a Sim(3) of the trajectories
    moving: ArrayLike | None = None,  # (H, W) bool, True where a dynamic object hides the scene
) -> float | None:  # units of the truth
    """Return the mean |scale D^ - D| over static pixels known to both; None if there is none."""
    # The scale is not that of the depths: a map too large for its trajectory is an error.
    depth, reference = np.asarray(depth, np.float64), np.asarray(reference, np.float64)
    hidden = np.zeros(depth.shape, bool) if moving is None else np.asarray(moving, bool)
    assert depth.shape == reference.shape == hidden.shape, (depth.shape, reference.shape)
    known = (depth > 0) & (reference > 0) & ~hidden
    if not known.any():
        return None
    return float(np.abs(scale * depth - reference)[known].mean())


def auroc(scores: ArrayLike, mask: ArrayLike) -> float:  # 1: perfect, 0.5: chance, 0: inverted
    """Return the area under the ROC curve: Mann and Whitney's U over the number of pairs.

    It is the probability that a random moving pixel (True in the mask, of the same shape) scores
    higher, for instance by beta, than a static one; equal scores count half. It needs no threshold.
    """
    scores = np.asarray(scores, dtype=np.float64).ravel()
    mask = np.asarray(mask, dtype=bool).ravel()
    positives, negatives = int(mask.sum()), int((~mask).sum())
    are_both = scores.shape == mask.shape and positives > 0 and negatives > 0
    kinds = f"{positives} moving and {negatives} static pixels"
    found = f"{scores.size} scores, {kinds}; choose frames with dynamic objects"
    require(are_both, "one score per pixel and pixels of both kinds", found)
    is_finite = bool(np.isfinite(scores).all())
    require(is_finite, "finite scores", "NaN or infinity; check the uncertainty")
    static, moving = np.sort(scores[~mask]), scores[mask]
    u = sum(np.searchsorted(static, moving, side).sum() for side in ("left", "right")) / 2
    return float(u / (positives * negatives))


def checked_images(image: ArrayLike, reference: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return two images of one shape, (H, W, 3) or (H, W), as float64 in [0, 1]."""
    image, reference = np.asarray(image), np.asarray(reference)
    for kind in (image.dtype, reference.dtype):
        found = f"{kind}; divide values in [0, 255] by 255"
        require(np.issubdtype(kind, np.floating), "images of floats in [0, 1]", found)
    assert image.shape == reference.shape and image.ndim in (2, 3), (image.shape, reference.shape)
    # A renderer may overshoot; what is shown and stored is clipped, so that is compared.
    return np.clip(image, 0, 1, dtype=np.float64), np.clip(reference, 0, 1, dtype=np.float64)


def _window_mean(values: np.ndarray) -> np.ndarray:
    """Return Gaussian means of (H, W, ...), for the (H-10, W-10, ...) windows that fit."""
    mean = gaussian_filter(values, _SSIM_SIGMA, radius=_SSIM_RADIUS, axes=(0, 1))
    return mean[_SSIM_RADIUS:-_SSIM_RADIUS, _SSIM_RADIUS:-_SSIM_RADIUS]
