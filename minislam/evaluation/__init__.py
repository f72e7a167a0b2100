"""Measures against the truth: trajectories, images, and the separation of movers."""

from minislam.evaluation.depth import depth_l1
from minislam.evaluation.images import psnr, ssim
from minislam.evaluation.novel_views import align_novel_views, truth_to_estimate
from minislam.evaluation.separability import auroc
from minislam.evaluation.trajectory import (
    Alignment,
    TrajectoryError,
    absolute_trajectory_error,
    path_length,
    relative_pose_error,
    straight_line_error,
)

__all__ = [
    "Alignment",
    "TrajectoryError",
    "absolute_trajectory_error",
    "align_novel_views",
    "auroc",
    "depth_l1",
    "path_length",
    "psnr",
    "relative_pose_error",
    "ssim",
    "straight_line_error",
    "truth_to_estimate",
]
