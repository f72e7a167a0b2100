"""What a dense flow says at the cells of the grid, to the last tenth of a pixel, and how surely.

Confidence is forward-backward agreement times texture times likeness.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from minislam.parameters import parameter
from minislam.priors.dense_flow import pixel_maps, sample, warp
from minislam.priors.interfaces import FlowMatches

LIKENESS_WINDOW = (9, 9)  # px
LK_WINDOW = (9, 9)  # px
LK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.003)  # steps, px
MAX_REMAINDER = 1.0  # px: what DIS leaves over is less, or the window sees something else
LEAST_VARIANCE = 1e-5  # of brightness in [0, 1]: below it there is nothing to correlate


@dataclass(frozen=True)
class ClassicalFlowConfig:
    """Constants of the classical flow."""

    stride: int = parameter(8, "distance between grid cells [px], as DROID-SLAM")
    consistency_scale: float = parameter(
        0.6, "forward-backward error at which confidence falls to exp(-1/2) [px]"
    )
    texture_scale: float = parameter(
        2e-4, "smaller eigenvalue of the structure tensor that halves confidence [1/px^2]"
    )
    start_tolerance: float = parameter(
        0.25, "an edge is measured again if its start has moved by this (median) [px]; 0: always"
    )
    workers: int = parameter(2, "threads that compute flows side by side; no effect on the result")


@dataclass(frozen=True)
class Windows:
    """Brightness in [0, 1] around each grid cell (h, w), of a source and of its warped target."""

    mean: np.ndarray
    variance: np.ndarray
    warped_mean: np.ndarray
    warped_variance: np.ndarray
    covariance: np.ndarray  # of the two


def measured_on_grid(
    source: np.ndarray,  # (H, W) uint8
    target: np.ndarray,  # (H, W) uint8
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    config: ClassicalFlowConfig,
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Return where each grid cell is in the target, as exactly as the images say, and how sure."""
    stride, warped = config.stride, warp(target, forward, cv2.INTER_CUBIC)
    windows = windows_of(source, warped, stride)
    remainder = lucas_kanade(source, same_exposure(warped, windows), stride)
    return grid_matches(forward, remainder, backward, likeness(windows) * texture, config)


def windows_of(source: np.ndarray, warped: np.ndarray, stride: int) -> Windows:
    """Return what is seen around each grid cell in two images (H, W) uint8."""

    def at_cells(image: np.ndarray) -> np.ndarray:
        return image[::stride, ::stride]

    mean, warped_mean = (
        at_cells(cv2.boxFilter(image, cv2.CV_32F, LIKENESS_WINDOW)) / 255
        for image in (source, warped)
    )
    square, warped_square, product = (
        at_cells(cv2.boxFilter(cv2.multiply(*images, dtype=cv2.CV_32F), -1, LIKENESS_WINDOW))
        / 255**2
        for images in ((source, source), (warped, warped), (source, warped))
    )
    return Windows(
        mean, square - mean**2, warped_mean, warped_square - warped_mean**2,
        product - mean * warped_mean,
    )  # fmt: skip


def same_exposure(warped: np.ndarray, windows: Windows) -> np.ndarray:
    """Return the warped image (H, W) uint8 with the brightness and contrast of the source.

    Both are medians over small windows, so that what moves or is covered has no say.
    """
    textured = np.minimum(windows.variance, windows.warped_variance) > LEAST_VARIANCE
    if not textured.any():
        return warped
    contrast = np.sqrt(np.median(windows.variance[textured] / windows.warped_variance[textured]))
    brightness = np.median((windows.mean - contrast * windows.warped_mean)[textured])
    return cv2.addWeighted(warped, contrast, warped, 0, 255 * brightness)


def lucas_kanade(source: np.ndarray, warped: np.ndarray, stride: int) -> np.ndarray:
    """Return the displacement (h, w, 2) [px] of each grid cell that the warp has left over.

    The flow of DIS is a blend of patches that overlap, off by some hundredths of a pixel in the
    same direction over large parts of an image, which turns the camera. A least-squares match of
    one window per cell has errors of its own, which average out.
    """
    cells = np.mgrid[: source.shape[0] : stride, : source.shape[1] : stride][::-1]
    points = cells.reshape(2, -1).T[:, None].astype(np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        source, warped, points, points.copy(), winSize=LK_WINDOW, maxLevel=0, criteria=LK_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    remainder = (moved - points).reshape(*cells.shape[1:], 2)
    usable = (found.reshape(cells.shape[1:]) == 1) & (np.abs(remainder).max(-1) < MAX_REMAINDER)
    return remainder * usable[..., None]


def grid_matches(
    forward: np.ndarray,  # (H, W, 2) px, flow source to target
    remainder: np.ndarray,  # (h, w, 2) px, what it has left over at the grid cells
    backward: np.ndarray,  # (H, W, 2) px, flow target to source
    texture: np.ndarray,  # (h, w) in [0, 1)
    config: ClassicalFlowConfig,
) -> tuple[np.ndarray, np.ndarray]:  # (h, w, 2) px, (h, w) in [0, 1)
    """Sample a flow on the grid and judge it: forward-backward agreement, texture, on the image."""
    height, width = forward.shape[:2]
    stride = config.stride
    column, row = (m[::stride, ::stride] for m in pixel_maps((height, width)))
    moved_u, moved_v = column + remainder[..., 0], row + remainder[..., 1]
    flow = sample(forward, moved_u, moved_v)
    target_u, target_v = moved_u + flow[..., 0], moved_v + flow[..., 1]
    returned = sample(backward, target_u, target_v)
    squared_error = ((remainder + flow + returned) ** 2).sum(-1)
    agreement = np.exp(-0.5 * squared_error / config.consistency_scale**2)
    inside = (target_u >= 0) & (target_u <= width - 1) & (target_v >= 0) & (target_v <= height - 1)
    return np.stack([target_u, target_v], -1), agreement * texture * inside


def texture_confidence(gray: np.ndarray, config: ClassicalFlowConfig) -> np.ndarray:
    """Return how well each grid cell can be located (h, w), in [0, 1).

    On a bare wall forward and backward flow agree on anything, so agreement alone is no
    confidence. The smaller eigenvalue of the structure tensor says whether a displacement in
    any direction would be noticed.
    """
    scaled = gray.astype(np.float32) / 255
    gx = cv2.Scharr(scaled, cv2.CV_32F, 1, 0) / 32  # 32: sum of the kernel's positive weights x 2
    gy = cv2.Scharr(scaled, cv2.CV_32F, 0, 1) / 32
    window = (7, 7)
    xx, yy, xy = (cv2.boxFilter(p, -1, window) for p in (gx * gx, gy * gy, gx * gy))
    smaller = 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)
    smaller = np.maximum(smaller[:: config.stride, :: config.stride], 0)
    return smaller / (smaller + config.texture_scale)


def likeness(windows: Windows) -> np.ndarray:
    """Return how alike a source and its warped target look around each cell (h, w), in [0, 1].

    It is the squared normalised cross-correlation, blind to exposure. Forward and backward flow
    agree with each other on a black target and, here and there, on any other: this asks the images.
    """
    squared_scale = np.maximum(windows.variance * windows.warped_variance, LEAST_VARIANCE**2)
    return np.clip(windows.covariance / np.sqrt(squared_scale), 0, 1) ** 2


def as_matches(
    targets: list[np.ndarray],  # per edge (h, w, 2) px
    confidences: list[np.ndarray],  # per edge (h, w)
    textures: list[np.ndarray],  # per edge (h, w), the most its confidence could be
    dtype: torch.dtype,
) -> FlowMatches:
    """Bundle the measurements of single edges."""
    matched = torch.from_numpy(np.stack(targets)).to(dtype).flatten(1, 2).mT.contiguous()
    confidence = torch.from_numpy(np.stack(confidences)).to(dtype)
    possible = torch.from_numpy(np.stack(textures)).to(dtype).sum((1, 2))
    ratios = confidence.sum((1, 2)) / possible.clamp_min(1e-6)
    return FlowMatches(matched, confidence.flatten(1)[:, None].repeat(1, 2, 1), ratios)
