"""Matches at the grid cells from a dense flow, refined to a tenth of a pixel, with confidences.

The confidence is forward-backward agreement times texture times similarity.
"""

from collections.abc import Sequence as Series
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.priors.dense_flow import pixel_positions, sample, warp
from minislam.priors.interfaces import FlowMatches

SIMILARITY_WINDOW = (9, 9)  # px
LK_WINDOW = (9, 9)  # px
LK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.003)  # steps, px
MAX_REMAINDER = 1.0  # px: the error of DIS is smaller; a larger remainder is a wrong match
LEAST_VARIANCE = 1e-5  # of brightness in [0, 1]: below it there is nothing to correlate
CONSISTENCY_SCALE = 0.6  # px, forward-backward error at which confidence falls to exp(-1/2)
TEXTURE_SCALE = 2e-4  # 1/px^2, smaller eigenvalue of the structure tensor that halves confidence


@dataclass(frozen=True)
class Windows:
    """Moments of brightness in [0, 1] around each cell (h, w), of source and warped target."""

    mean: np.ndarray
    variance: np.ndarray
    warped_mean: np.ndarray
    warped_variance: np.ndarray
    covariance: np.ndarray  # of the two


def measure_on_grid(
    source: np.ndarray,  # (H, W) uint8
    target: np.ndarray,  # (H, W) uint8
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    stride: int,  # px
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Return the position of each grid cell in the target, refined by Lucas-Kanade; confidence."""
    warped = warp(target, forward, cv2.INTER_CUBIC)
    windows = windows_of(source, warped, stride)
    remainder = lucas_kanade(source, match_exposure(warped, windows), stride)
    return grid_matches(forward, remainder, backward, similarity(windows) * texture, stride)


def windows_of(source: np.ndarray, warped: np.ndarray, stride: int) -> Windows:
    """Return means, variances and covariance of two images (H, W) uint8 around each cell."""

    def mean_around(image: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(image, cv2.CV_32F, SIMILARITY_WINDOW)[::stride, ::stride]

    def covariance(i: int, j: int) -> np.ndarray:
        product = cv2.multiply(images[i], images[j], dtype=cv2.CV_32F)
        return mean_around(product) / 255**2 - means[i] * means[j]

    images = source, warped
    means = [mean_around(image) / 255 for image in images]
    return Windows(means[0], covariance(0, 0), means[1], covariance(1, 1), covariance(0, 1))


def match_exposure(warped: np.ndarray, windows: Windows) -> np.ndarray:
    """Return the warped image (H, W) uint8 with the brightness and contrast of the source.

    Both are medians over small windows, so that moving or covered regions do not matter.
    """
    textured = np.minimum(windows.variance, windows.warped_variance) > LEAST_VARIANCE
    if not textured.any():
        return warped
    contrast = np.sqrt(np.median(windows.variance[textured] / windows.warped_variance[textured]))
    brightness = np.median((windows.mean - contrast * windows.warped_mean)[textured])
    return cv2.addWeighted(warped, contrast, warped, 0, 255 * brightness)


def lucas_kanade(source: np.ndarray, warped: np.ndarray, stride: int) -> np.ndarray:
    """Return the displacement (h, w, 2) [px] that remains at each grid cell after the warp.

    DIS blends overlapping patches. Its errors, some hundredths of a pixel, have one direction over
    large parts of an image and so rotate the camera. Those of one window per cell are independent.
    """
    cells = pixel_positions(source.shape, stride)
    points = cells.reshape(-1, 1, 2)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        source, warped, points, points.copy(), winSize=LK_WINDOW, maxLevel=0, criteria=LK_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    remainder = (moved - points).reshape(cells.shape)
    usable = (found.reshape(cells.shape[:2]) == 1) & (np.abs(remainder).max(-1) < MAX_REMAINDER)
    return remainder * usable[..., None]


def grid_matches(
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    remainder: np.ndarray,  # (h, w, 2) px, what it lacks at the grid cells
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    stride: int,  # px
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Sample a flow at the cells; confidence: texture times forward-backward agreement."""
    height, width = forward.shape[:2]
    moved = pixel_positions((height, width), stride) + remainder
    flow = sample(forward, moved)
    targets = moved + flow
    returned = sample(backward, targets)
    squared_error = ((remainder + flow + returned) ** 2).sum(-1)
    agreement = np.exp(-0.5 * squared_error / CONSISTENCY_SCALE**2)
    inside = ((targets >= 0) & (targets <= (width - 1, height - 1))).all(-1)
    return targets, agreement * texture * inside


def texture_confidence(gray: np.ndarray, stride: int) -> np.ndarray:
    """Return how well each grid cell can be located (h, w), in [0, 1).

    On a bare wall forward and backward flow agree although both are wrong. If the smaller
    eigenvalue of the structure tensor is large, a displacement in any direction changes the image.
    """
    scaled = gray.astype(np.float32) / 255
    gx = cv2.Scharr(scaled, cv2.CV_32F, 1, 0) / 32  # 32: sum of the kernel's positive weights x 2
    gy = cv2.Scharr(scaled, cv2.CV_32F, 0, 1) / 32
    xx, yy, xy = (cv2.boxFilter(p, -1, (7, 7)) for p in (gx * gx, gy * gy, gx * gy))
    smaller = 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    smaller = np.maximum(smaller[::stride, ::stride], 0)
    return smaller / (smaller + TEXTURE_SCALE)


def similarity(windows: Windows) -> np.ndarray:
    """Return the similarity of source and warped target around each cell (h, w), in [0, 1].

    It is the squared normalised cross-correlation, which does not depend on the exposure. Without
    it a black target would match, since forward and backward flow agree there.
    """
    squared_scale = np.maximum(windows.variance * windows.warped_variance, LEAST_VARIANCE**2)
    return np.clip(windows.covariance / np.sqrt(squared_scale), 0, 1) ** 2


def as_matches(
    targets: Series[np.ndarray],  # per edge (h, w, 2) px
    confidences: Series[np.ndarray],  # per edge (h, w)
    textures: Series[np.ndarray],  # per edge (h, w), the most its confidence could be
    like: Tensor,  # of the dtype and on the device wanted
) -> FlowMatches:
    """Stack the measurements of E edges; compute the matched ratio of each edge."""
    grids = targets, confidences, textures
    matched, confidence, texture = (torch.from_numpy(np.stack(g)).to(like) for g in grids)
    matched, possible = matched.flatten(1, 2).mT.contiguous(), texture.sum((1, 2))
    ratios = confidence.sum((1, 2)) / possible.clamp_min(1e-6)
    return FlowMatches(matched, confidence.flatten(1)[:, None].expand(-1, 2, -1), ratios)
