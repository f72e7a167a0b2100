"""Compare a run with the ground truth: trajectory, images, depth, separation by beta."""

from minislam.evaluation.images import auroc, depth_l1, psnr
from minislam.evaluation.trajectory import absolute_trajectory_error, straight_line_error

__all__ = ["absolute_trajectory_error", "auroc", "depth_l1", "psnr", "straight_line_error"]
