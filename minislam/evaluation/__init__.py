"""Compare a run with the ground truth: trajectory, images, depth, separation by beta."""

from minislam.evaluation.images import auroc, depth_l1, psnr, ssim
from minislam.evaluation.trajectory import (
    Alignment,
    TrajectoryError,
    absolute_trajectory_error,
    relative_pose_error,
    straight_line_error,
    truth_to_estimate,
)

__all__ = [
    "Alignment",
    "TrajectoryError",
    "absolute_trajectory_error",
    "auroc",
    "depth_l1",
    "psnr",
    "relative_pose_error",
    "ssim",
    "straight_line_error",
    "truth_to_estimate",
]
