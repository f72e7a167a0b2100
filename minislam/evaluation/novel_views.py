"""Held-out views: from the benchmark's world into the world of the map."""

import numpy as np
from scipy.spatial.transform import Rotation

from minislam.evaluation.trajectory import (
    DEFAULT_MAX_DIFFERENCE,
    Alignment,
    centres,
    fit_alignment,
    paired,
)
from minislam.geometry.alignment import Similarity
from minislam.records import Trajectory


def truth_to_estimate(
    estimate: Trajectory, truth: Trajectory, max_difference: float = DEFAULT_MAX_DIFFERENCE
) -> Similarity:
    """Return the Sim(3) that best maps true camera centres to the estimated ones.

    It is fitted in this direction, so the error is least in the world where the map is rendered.
    """
    estimate, truth = paired(estimate, truth, max_difference)
    return fit_alignment(truth, estimate, Alignment.SIM3)


def oriented_truth_to_estimate(
    estimate: Trajectory, truth: Trajectory, max_difference: float = DEFAULT_MAX_DIFFERENCE
) -> Similarity:
    """Return the Sim(3) from truth to estimate whose rotation is that of the cameras.

    The centres of a camera that hardly leaves a line say little of the turn about that line, and
    a turn by 3 mrad moves a held-out view by a pixel. The orientations know that turn better.
    Scale and translation still come from the centres.
    """
    estimate, truth = paired(estimate, truth, max_difference)
    turned = estimate.T_world_camera[:, :3, :3] @ truth.T_world_camera[:, :3, :3].mT
    rotation = Rotation.from_matrix(turned).mean().as_matrix()
    source, target = centres(truth), centres(estimate)
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_turned = (source - source_mean) @ rotation.T
    scale = float((source_turned * (target - target_mean)).sum() / (source_turned**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def align_novel_views(
    T_world_camera: np.ndarray,  # (N, 4, 4) or (4, 4), poses in the benchmark's world
    similarity: Similarity,  # maps the benchmark's world to that of the map
) -> np.ndarray:  # the same shape, poses in the world of the map
    """Return the poses from which to render the map for held-out images.

    With the similarity (s, R, t): R' = R R_true and c' = s R c_true + t. The error of the
    estimated trajectory therefore enters every measure taken at these views.
    """
    return similarity.transform_poses(T_world_camera)
