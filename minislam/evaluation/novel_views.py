"""Held-out views: from the benchmark's world into the world of the map."""

import numpy as np

from minislam.evaluation.trajectory import DEFAULT_MAX_DIFFERENCE, Alignment, fit_alignment, paired
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


def align_novel_views(
    T_world_camera: np.ndarray,  # (N, 4, 4) or (4, 4), poses in the benchmark's world
    similarity: Similarity,  # maps the benchmark's world to that of the map
) -> np.ndarray:  # the same shape, poses in the world of the map
    """Return the poses from which to render the map for held-out images.

    With the similarity (s, R, t): R' = R R_true and c' = s R c_true + t. The error of the
    estimated trajectory therefore enters every measure taken at these views.
    """
    return similarity.transform_poses(T_world_camera)
