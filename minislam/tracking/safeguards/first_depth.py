"""The first depth from flow alone: an essential matrix, then triangulation.

The paper starts from the depth prior, so it needs neither.
"""

import cv2
import torch
from torch import Tensor

from minislam.geometry.distortion import camera_matrix
from minislam.geometry.se3 import make_transform
from minislam.tracking.grid import Grid

ESSENTIAL_THRESHOLD = 0.7  # px, RANSAC inlier distance to the epipolar line
MIN_CELLS_FOR_ESSENTIAL = 40  # confident cells; five define the matrix, noise wants many more
DISPARITY_SPREAD = 20.0  # largest ratio of a triangulated disparity to the median, both ways


def triangulate(
    grid: Grid,
    T_target_source: Tensor,  # (4, 4)
    targets: Tensor,  # (N, 2) px
    confident: Tensor,  # (N,) bool
) -> Tensor:  # (N,)
    """Return the disparities that best explain matches under a known motion.

    R rho + d t must be parallel to the matched ray: two equations linear in d, by least squares.
    """
    T_target_source = T_target_source.to(grid.rays)
    rotated, t = grid.rays @ T_target_source[:3, :3].T, T_target_source[:3, 3]
    seen = grid.camera.rays(targets)[:, :2]
    factor = t[:2] - seen * t[2]
    value = seen * rotated[:, 2:] - rotated[:, :2]
    disparities = (factor * value).sum(1) / factor.square().sum(1).clamp_min(1e-12)
    usable = confident & (disparities > 0)
    if not usable.any():
        return torch.ones_like(disparities)
    typical = disparities[usable].median()
    usable &= disparities < DISPARITY_SPREAD * typical
    usable &= disparities > typical / DISPARITY_SPREAD
    return torch.where(usable, disparities, typical) / typical


def essential_disparities(
    grid: Grid,
    targets: Tensor,  # (N, 2) px
    confidences: Tensor,  # (N, 2)
) -> Tensor | None:  # (N,)
    """Return disparities of the source from an essential matrix, median 1, or None."""
    confident = confidences[:, 0] > 0.5
    if int(confident.sum()) < MIN_CELLS_FOR_ESSENTIAL:
        return None
    source, target = (pixels[confident].double().cpu().numpy() for pixels in (grid.pixels, targets))
    matrix = camera_matrix(grid.camera)
    cv2.setRNGSeed(0)
    essential, inliers = cv2.findEssentialMat(
        source, target, matrix, cv2.RANSAC, 0.999, ESSENTIAL_THRESHOLD
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, source, target, matrix, mask=inliers)
    motion = torch.from_numpy(rotation), torch.from_numpy(translation[:, 0])
    return triangulate(grid, make_transform(*motion), targets, confident)
