"""Similarities from the benchmark's world to the world of the map, for held-out views.

With the similarity (s, R, t), the pose of a held-out view becomes R' = R R_true and
c' = s R c_true + t. So the error of the trajectory enters every measure taken at these views.
"""

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
    """Return the Sim(3) that maps true camera centres to estimated ones with least error.

    Fitted in this direction, the error is least in the world where the map is rendered.
    """
    estimate, truth = paired(estimate, truth, max_difference)
    return fit_alignment(truth, estimate, Alignment.SIM3)


def oriented_truth_to_estimate(
    estimate: Trajectory, truth: Trajectory, max_difference: float = DEFAULT_MAX_DIFFERENCE
) -> Similarity:
    """Return the Sim(3) from truth to estimate with the mean rotation between the cameras.

    If the camera moves nearly along a line, its centres hardly determine the rotation about that
    line, and 3 mrad of it move a held-out view by a pixel. The orientations determine it.
    Scale and translation come from the centres.
    """
    estimate, truth = paired(estimate, truth, max_difference)
    turned = estimate.T_world_camera[:, :3, :3] @ truth.T_world_camera[:, :3, :3].mT
    rotation = Rotation.from_matrix(turned).mean().as_matrix()
    source, target = centres(truth), centres(estimate)
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_turned = (source - source_mean) @ rotation.T
    scale = float((source_turned * (target - target_mean)).sum() / (source_turned**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)
