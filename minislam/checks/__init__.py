"""Checks of the exercises of the notebooks: each takes the student's function.

A check calls the function with a few inputs, compares the answers with the package, and returns a
sentence that names the first wrong number. It never raises, so that a notebook with open exercises
still runs from top to bottom. Three more are for authors of priors: `check_depth_prior`,
`check_feature_extractor` and `check_flow_estimator` raise InputError for what is no such thing.
"""

from minislam.checks.bundle_adjustment import (
    check_bundle_adjustment,
    check_prior_mask,
    check_robust_weight,
    check_schur_step,
    check_target_jacobian,
)
from minislam.checks.cases import Case
from minislam.checks.geometry import check_reproject, check_resized_intrinsics, check_warped_photo
from minislam.checks.grading import NOT_YET, PASSED, WRONG, Verdict, check_function, is_written
from minislam.checks.mapping import (
    check_deformed_means,
    check_followed_pose,
    check_insertion,
    check_map_loss,
    check_sampling,
)
from minislam.checks.real_video import check_gains, check_stride
from minislam.checks.slam import check_alignment, check_ate, check_separability, check_sign_test
from minislam.checks.splatting import (
    check_conic_vjp,
    check_picture_gradient,
    check_pixel_color,
    check_projected_covariance,
    check_rendered_image,
    check_twist_vjp,
)
from minislam.checks.stereo import check_plane_cost, check_plane_homography
from minislam.checks.tracking import (
    check_bounded_loss,
    check_flow_distance,
    check_keyframes,
    check_motion_memory,
    check_suppressed,
)
from minislam.checks.uncertainty import (
    check_best_beta,
    check_feature_variance,
    check_mapping_weight,
    check_training,
)
from minislam.priors.conformance import (
    check_depth_prior,
    check_feature_extractor,
    check_flow_estimator,
)

__all__ = [
    "NOT_YET", "PASSED", "WRONG", "Case", "Verdict", "check_alignment", "check_ate",
    "check_best_beta", "check_bounded_loss", "check_bundle_adjustment", "check_conic_vjp",
    "check_deformed_means", "check_depth_prior", "check_feature_extractor",
    "check_feature_variance", "check_flow_distance", "check_flow_estimator", "check_followed_pose",
    "check_function", "check_gains", "check_insertion", "check_keyframes", "check_map_loss",
    "check_mapping_weight", "check_motion_memory", "check_picture_gradient", "check_pixel_color",
    "check_plane_cost", "check_plane_homography", "check_prior_mask", "check_projected_covariance",
    "check_rendered_image", "check_reproject", "check_resized_intrinsics", "check_robust_weight",
    "check_sampling", "check_schur_step", "check_separability", "check_sign_test", "check_stride",
    "check_suppressed", "check_target_jacobian", "check_training", "check_twist_vjp",
    "check_warped_photo", "is_written",
]  # fmt: skip
