"""Plane sweep: how well each pixel of an image matches other images at each depth.

A plane parallel to this image, at inverse depth q, warps another one into it by the homography

    H(q) = K (R + q t e3^T) K^-1,        with T_other_this = (R, t).

Where the plane lies on the surface that a pixel shows, the warped image equals this one. So the
cost of a pixel over all planes has its minimum at its depth. A moving object matches at a depth
that differs from view to view, or nowhere.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from minislam.geometry import Camera
from minislam.geometry.distortion import camera_matrix

NCC_WINDOW = (5, 5)  # px, that are correlated
NCC_VARIANCE = 4e-4  # of grey values in [0, 1]: contrast below its root does not count
DIFFERENCE_WINDOW = (3, 3)  # px, of the absolute difference
DIFFERENCE_SCALE = 0.06  # grey values: a larger difference counts no more
DIFFERENCE_WEIGHT = 0.15  # of the absolute difference beside the correlation [-]
MIN_SEEN = 0.25  # of the views that must see a pixel's plane [-]
UNSEEN_COST = 0.8  # of a plane that fewer views see: neither right nor wrong [-]
OUTSIDE = -1e4  # grey value outside of an image; mixed into a pixel, it makes it negative


@dataclass(frozen=True)
class PosedImage:
    """A grey image and its pose."""

    gray: np.ndarray  # (h, w) float32 in [0, 1]
    T_camera_world: np.ndarray  # (4, 4) float64


def plane_homographies(
    camera: Camera,
    T_other_this: np.ndarray,  # (4, 4)
    inverse_depths: np.ndarray,  # (D,) 1/world unit
) -> np.ndarray:  # (D, 3, 3)
    """Return H(q): where a pixel of this image, lying on plane q, is seen in the other image."""
    K = camera_matrix(camera)
    rotation, translation = T_other_this[:3, :3], T_other_this[:3, 3]
    motion = np.repeat(rotation[None], len(inverse_depths), 0)
    motion[:, :, 2] += inverse_depths[:, None] * translation
    return K @ motion @ np.linalg.inv(K)


def sweep(
    camera: Camera,  # of all images
    reference: PosedImage,
    others: list[PosedImage],  # V views
    inverse_depths: np.ndarray,  # (D,) 1/world unit, of the planes
) -> np.ndarray:  # (D, h, w) float32 in [0, 1]
    """Return the matching cost of every pixel and plane.

    The better half of the views is averaged: in the other, things may cover the pixel or move.
    """
    T_world_this = np.linalg.inv(reference.T_camera_world)
    motions = [other.T_camera_world @ T_world_this for other in others]
    homographies = np.stack([plane_homographies(camera, T, inverse_depths) for T in motions], 1)
    gray = reference.gray
    mean, variance = _moments(gray)
    spread = np.sqrt(variance + NCC_VARIANCE)

    def dissimilarity(warped: np.ndarray) -> np.ndarray:  # 2 x (h, w), the result in [0, 1]
        """Return 1 - max(NCC, 0), mixed with the absolute difference; one view fits the cache."""
        mean_warped, variance_warped = _moments(warped)
        covariance = cv2.blur(gray * warped, NCC_WINDOW) - mean * mean_warped
        ncc = covariance / (spread * np.sqrt(variance_warped + NCC_VARIANCE))
        difference = cv2.blur(np.abs(gray - warped), DIFFERENCE_WINDOW)
        absolute = np.minimum(difference / DIFFERENCE_SCALE, 1)
        return (1 - DIFFERENCE_WEIGHT) * (1 - ncc.clip(0, 1)) + DIFFERENCE_WEIGHT * absolute

    cost = np.empty((len(inverse_depths), *gray.shape), np.float32)
    for plane, of_views in enumerate(homographies):
        costs, seen = [], np.empty((len(others), *gray.shape), bool)
        for view, (other, H) in enumerate(zip(others, of_views, strict=True)):
            warped = warp(other.gray, H)
            np.greater_equal(warped, 0, out=seen[view])
            costs.append(dissimilarity(np.where(seen[view], warped, gray)))
        cost[plane] = _mean_of_better_half(costs, seen)
    return cost


def warp(gray: np.ndarray, H: np.ndarray) -> np.ndarray:  # (h, w)
    """Return the image sampled at H p for every pixel p, negative outside of the image."""
    height, width = gray.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1.0]])
    # A plane that reaches behind the other camera would be mirrored: it counts as not seen.
    if (corners @ H[2]).min() <= 0:
        return np.full_like(gray, OUTSIDE)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(gray, H, (width, height), flags=flags, borderValue=OUTSIDE)


def _moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance (h, w) of the window around each pixel."""
    mean = cv2.blur(image, NCC_WINDOW)
    return mean, np.maximum(cv2.blur(image * image, NCC_WINDOW) - mean * mean, 0)


def _mean_of_better_half(
    costs: list[np.ndarray],  # (h, w) of each of V views
    seen: np.ndarray,  # (V, h, w) bool, whether the view sees the pixel
) -> np.ndarray:  # (h, w)
    """Return the mean of the lower half of the costs of the views that see a pixel."""
    number = seen.sum(0, dtype=np.uint8)
    half = np.maximum((number + 1) // 2, 1)
    left = [np.where(s, cost, np.float32(2)) for cost, s in zip(costs, seen, strict=True)]
    total = np.zeros_like(left[0])
    for rank in range((len(costs) + 1) // 2):  # each pass takes the lowest cost of each pixel out
        lowest = left.pop()
        for view, cost in enumerate(left):
            lowest, left[view] = np.minimum(lowest, cost), np.maximum(lowest, cost)
        total += lowest * (rank < half)
    return np.where(number >= max(1, MIN_SEEN * len(costs)), total / half, UNSEEN_COST)
