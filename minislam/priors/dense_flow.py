"""Dense optical flow (OpenCV's DIS), and how to warp by it, compose it and invert it.

Dense inverse search (DIS) finds small displacements well, large ones badly. So the target is first
warped by the expected displacement, DIS finds the rest, and both are composed ("warp-compose").
"""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from torch import Tensor

CORNERS, CONTRAST = 1500, 8  # most corners of an image; their least contrast [grey values]
LEAST_CORNERS, CORNER_ERROR = 12, 4.0  # least inliers of a homography; their largest error [px]


def grayscale(image: Tensor) -> np.ndarray:
    """Return the 8-bit luminance (H, W) of an image (H, W, 3) in [0, 1]."""
    rgb = (image.cpu().numpy() * 255 + 0.5).astype(np.uint8)
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


@lru_cache(maxsize=8)  # to build it takes half as long as to warp by it
def pixel_positions(shape: tuple[int, int], stride: int = 1) -> np.ndarray:  # (h, w, 2) float32
    """Return column and row of every pixel, or of each `stride`-th; not to be changed."""
    sides = (np.arange(0, side, stride, dtype=np.float32) for side in (shape[1], shape[0]))
    return np.stack(np.meshgrid(*sides), -1)


def sample(image: np.ndarray, positions: np.ndarray, method: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Return the image at positions (h, w, 2) [px]; outside, the nearest border pixel counts."""
    rows: Any = None  # they stand beside the columns
    return cv2.remap(image, positions, rows, method, borderMode=cv2.BORDER_REPLICATE)


def warp(image: np.ndarray, flow: np.ndarray, method: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Return image(p + flow(p))."""
    return sample(image, pixel_positions(flow.shape[:2]) + flow, method)


def dense_from_grid(grid_targets: np.ndarray, shape: tuple[int, int], stride: int) -> np.ndarray:
    """Return the dense flow (H, W, 2) that interpolates grid target positions (h, w, 2) [px]."""
    grid_flow = grid_targets - stride * pixel_positions(grid_targets.shape[:2])
    return sample(grid_flow, pixel_positions(shape) / stride)


def residual_flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the DIS flow (H, W, 2) with source(p) = target(p + flow(p)), found from zero."""
    # One object per call: DIS keeps its buffers inside, so objects cannot be shared by threads.
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    return dis.calc(source, target, None)


def composed_flow(source: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the flow from source to target (H, W, 2), started from `start` by warp-compose.

    With W(p) = target(p + start(p)) and source(p) = W(p + r(p)), the target position of p is
    p + r(p) + start(p + r(p)).
    """
    remainder = residual_flow(source, warp(target, start))
    return remainder + warp(start, remainder)


def plane_flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the flow (H, W, 2) of the homography that most matched corners follow, or 0.

    It is the flow of a plane, and that of everything if the camera only turns, however far.
    """
    pixels = pixel_positions(source.shape[:2])
    orb = cv2.ORB_create(CORNERS, fastThreshold=CONTRAST)  # type: ignore[attr-defined]
    (here, codes), (there, others) = (orb.detectAndCompute(i, None) for i in (source, target))
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    pairs = matcher.match(codes, others) if here and there else []
    if len(pairs) < LEAST_CORNERS:
        return np.zeros_like(pixels)
    start = np.array([here[pair.queryIdx].pt for pair in pairs])
    end = np.array([there[pair.trainIdx].pt for pair in pairs])
    homography, inside = cv2.findHomography(start, end, cv2.RANSAC, CORNER_ERROR)
    if homography is None or inside.sum() < LEAST_CORNERS:
        return np.zeros_like(pixels)
    return cv2.perspectiveTransform(pixels, homography) - pixels


def reverse_flow(source: np.ndarray, target: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the flow from target to source (H, W, 2), started at the inverse of `forward`.

    The inverse is a fixed point: b(q) = -forward(q + b(q)). After three iterations DIS corrects it.
    """
    inverse = -forward
    for _ in range(3):
        inverse = -warp(forward, inverse)
    return composed_flow(target, source, inverse)
