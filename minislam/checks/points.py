"""The exercises of the course and what each is worth: one row an exercise.

`minislam grade` counts with this table. A test compares it with the headings of the notebooks,
which also say how hard an exercise is: "### Exercise 2: title (★★☆, 10 minutes, 2 points)".
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Exercise:
    """One exercise of a notebook."""

    key: str  # "ex03_2": notebook 03, second exercise; also the pytest marker
    notebook: str  # file name without .ipynb
    check: str  # name in minislam.checks
    points: int  # warm-ups have 2, building exercises 8


EXERCISES = (
    Exercise("ex00_1", "00_start_here", "check_mapping_weight", 2),
    Exercise("ex01_1", "01_geometry", "check_resized_intrinsics", 2),
    Exercise("ex01_2", "01_geometry", "check_reproject", 2),
    Exercise("ex01_3", "01_geometry", "check_warped_photo", 8),
    Exercise("ex02_1", "02_splatting", "check_projected_covariance", 2),
    Exercise("ex02_2", "02_splatting", "check_pixel_color", 2),
    Exercise("ex02_3", "02_splatting", "check_rendered_image", 8),
    Exercise("ex03_1", "03_splatting_gradients", "check_conic_vjp", 2),
    Exercise("ex03_2", "03_splatting_gradients", "check_twist_vjp", 2),
    Exercise("ex03_3", "03_splatting_gradients", "check_picture_gradient", 8),
    Exercise("ex04_1", "04_uncertainty", "check_best_beta", 2),
    Exercise("ex04_2", "04_uncertainty", "check_feature_variance", 2),
    Exercise("ex04_3", "04_uncertainty", "check_training", 8),
    Exercise("ex05_1", "05_bundle_adjustment", "check_target_jacobian", 2),
    Exercise("ex05_2", "05_bundle_adjustment", "check_schur_step", 2),
    Exercise("ex05_3", "05_bundle_adjustment", "check_bundle_adjustment", 8),
    Exercise("ex05b_1", "05b_weights_and_prior", "check_robust_weight", 2),
    Exercise("ex05b_2", "05b_weights_and_prior", "check_prior_mask", 8),
    Exercise("ex06_1", "06_tracking", "check_flow_distance", 2),
    Exercise("ex06_2", "06_tracking", "check_suppressed", 2),
    Exercise("ex06_3", "06_tracking", "check_keyframes", 8),
    Exercise("ex06b_1", "06b_start_and_lost", "check_bounded_loss", 2),
    Exercise("ex06b_2", "06b_start_and_lost", "check_motion_memory", 8),
    Exercise("ex07_1", "07_mapping", "check_sampling", 2),
    Exercise("ex07_2", "07_mapping", "check_deformed_means", 2),
    Exercise("ex07_3", "07_mapping", "check_insertion", 8),
    Exercise("ex07_4", "07_mapping", "check_map_loss", 2),
    Exercise("ex07_5", "07_mapping", "check_followed_pose", 8),
    Exercise("ex07b_1", "07b_dense_structure", "check_plane_homography", 2),
    Exercise("ex07b_2", "07b_dense_structure", "check_plane_cost", 8),
    Exercise("ex08_1", "08_full_slam", "check_ate", 2),
    Exercise("ex08_2", "08_full_slam", "check_separability", 2),
    Exercise("ex08_3", "08_full_slam", "check_alignment", 8),
    Exercise("ex09_1", "09_real_video", "check_gains", 2),
    Exercise("ex09_2", "09_real_video", "check_stride", 8),
    Exercise("ex10_1", "10_results", "check_sign_test", 2),
)
# For `minislam grade --no-package`: an answer may call all of minislam.geometry, and what is named
# here, less what is refused. Names as Python prints them: "Camera.resized".
MAY_CALL = {
    "ex04_3": "UncertaintyMLP.forward",
    "ex05_3": "BundleState relative_transforms reproject reproject_with_jacobians",
    "ex06_1": "relative_transforms reproject",
    "ex06_3": "composed_flow reverse_flow warp",
    "ex06b_2": "reproject filled_from_nearest",
    "ex07_5": "render _Render.backward curvature",
}
MAY_NOT_CALL = {"ex01_1": "Camera.resized", "ex08_3": "umeyama fit_alignment"}
