"""All measures of one run against the ground truth, as in the paper (Sec. 4)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from minislam.errors import InputError
from minislam.evaluation.images import auroc, depth_l1, psnr, ssim
from minislam.evaluation.trajectory import (
    absolute_trajectory_error,
    oriented_truth_to_estimate,
    straight_line_error,
    truth_to_estimate,
)
from minislam.records import GroundTruth, Trajectory

MAX_DIFFERENCE = 0.02  # second between a frame and its true pose; TUM stamps differ by 0.005
ImageDistance = Callable[[np.ndarray, np.ndarray], float]  # rendered, true (H, W, 3) RGB
MIN_MASK = 20  # px of dynamic objects below which a view does not measure ghosts
CENTIMETRES = 100.0  # per world unit of the truth, which is metric


@dataclass(frozen=True)
class MappedView:
    """A keyframe at the end of a run."""

    frame_index: int
    T_world_camera: np.ndarray  # (4, 4) estimated
    beta: np.ndarray | None  # (H, W), None if no beta was learnt
    depth: np.ndarray | None = None  # (H, W) rendered z in units of the map, 0 where transparent


def measure_run(
    truth: GroundTruth | None,
    trajectory: Trajectory,
    keyframe_trajectory: Trajectory,
    views: list[MappedView],
    render: Callable[[np.ndarray], np.ndarray],  # T_world_camera (4, 4) -> RGB (H, W, 3)
    lpips: ImageDistance | None = None,  # needs weights; without it two metrics are left out
) -> dict[str, float | None]:
    """Return the metrics by name, units in the names; None for what cannot be known."""
    metrics: dict[str, float | None] = dict.fromkeys(
        (
            "ate_all_cm", "ate_keyframes_cm", "ate_straight_line_cm", "psnr_novel_db",
            "ssim_novel", "psnr_novel_oriented_db", "psnr_input_db", "psnr_masked_db",
            "beta_auroc", "depth_l1_cm",
        )
    )  # fmt: skip
    if lpips is not None:
        metrics |= {"lpips_novel": None, "lpips_input": None}
    if truth is None:
        return metrics
    if truth.trajectory is not None:
        metrics["ate_all_cm"] = ate_cm(trajectory, truth.trajectory)
        metrics["ate_keyframes_cm"] = ate_cm(keyframe_trajectory, truth.trajectory)
        metrics["ate_straight_line_cm"] = CENTIMETRES * straight_line_error(truth.trajectory)
        if metrics["ate_all_cm"] is not None:
            metrics |= _novel_views(truth, truth.trajectory, trajectory, render, lpips)
            metrics["depth_l1_cm"] = _depth_l1_cm(truth, truth.trajectory, trajectory, views)
    metrics |= _input_views(truth, views, render, lpips)
    metrics["beta_auroc"] = _beta_auroc(truth, views)
    return metrics


def ate_cm(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Return the ATE [cm], None where nothing can be aligned."""
    try:
        error = absolute_trajectory_error(estimate, truth, max_difference=MAX_DIFFERENCE)
    except InputError:
        return None  # too few poses in common, or a camera that never moved: nothing to align
    return CENTIMETRES * error.statistics["rmse"]


def _novel_views(
    truth: GroundTruth,
    true_trajectory: Trajectory,
    trajectory: Trajectory,
    render: Callable[[np.ndarray], np.ndarray],
    lpips: ImageDistance | None,
) -> dict[str, float | None]:
    """Compare held-out static views with renderings from their Sim(3)-aligned poses.

    The paper aligns by camera centres. `psnr_novel_oriented_db` aligns by the orientations too,
    so that errors of the alignment count less and errors of the map count more.
    """
    views = truth.novel_views()
    if not views:
        return {}
    similarity = truth_to_estimate(trajectory, true_trajectory, MAX_DIFFERENCE)
    oriented = oriented_truth_to_estimate(trajectory, true_trajectory, MAX_DIFFERENCE)
    pairs = [(render(similarity.transform_poses(pose)), image) for pose, image in views]
    metrics = {
        "psnr_novel_oriented_db": _mean(
            [psnr(render(oriented.transform_poses(pose)), image) for pose, image in views]
        ),
        "psnr_novel_db": _mean([psnr(rendered, image) for rendered, image in pairs]),
        "ssim_novel": _mean([ssim(rendered, image) for rendered, image in pairs]),
    }
    if lpips is not None:
        metrics["lpips_novel"] = _mean([lpips(rendered, image) for rendered, image in pairs])
    return metrics


def _input_views(
    truth: GroundTruth,
    views: list[MappedView],
    render: Callable[[np.ndarray], np.ndarray],
    lpips: ImageDistance | None,
) -> dict[str, float | None]:
    """Compare renderings from the keyframes with the same views of the static scene.

    `psnr_masked_db` counts only pixels that a dynamic object covered: its ghost would be there.
    """
    whole: list[float] = []
    masked: list[float] = []
    distances: list[float] = []
    for view in views:
        static = truth.static_image(view.frame_index)
        if static is None:
            continue
        rendered = render(view.T_world_camera)
        whole.append(psnr(rendered, static))
        if lpips is not None:
            distances.append(lpips(rendered, static))
        mask = truth.moving_mask(view.frame_index)
        if mask is not None and mask.sum() >= MIN_MASK:
            masked.append(psnr(rendered, static, mask))
    metrics = {"psnr_input_db": _mean(whole), "psnr_masked_db": _mean(masked)}
    return metrics if lpips is None else {**metrics, "lpips_input": _mean(distances)}


def _depth_l1_cm(
    truth: GroundTruth, true_trajectory: Trajectory, trajectory: Trajectory, views: list[MappedView]
) -> float | None:
    """Compare the map's depth in the keyframes with the truth where the scene is static."""
    aligned = absolute_trajectory_error(trajectory, true_trajectory, max_difference=MAX_DIFFERENCE)
    errors = []
    for view in views:
        reference = truth.depth(view.frame_index)
        if reference is None or view.depth is None:
            continue
        moving = truth.moving_mask(view.frame_index)
        error = depth_l1(view.depth, reference, aligned.similarity.scale, moving)
        if error is not None:
            errors.append(CENTIMETRES * error)
    return _mean(errors)


def _beta_auroc(truth: GroundTruth, views: list[MappedView]) -> float | None:
    """Return how well beta separates moving from static pixels, over all keyframes together."""
    scores, masks = [], []
    for view in views:
        mask = truth.moving_mask(view.frame_index)
        if view.beta is not None and mask is not None:
            scores.append(view.beta.ravel())
            masks.append(mask.ravel())
    if not masks or not np.concatenate(masks).any():
        return None
    return auroc(np.concatenate(scores), np.concatenate(masks))


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
