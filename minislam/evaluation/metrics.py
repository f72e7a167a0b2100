"""All measures of one run against the ground truth, as in the paper (Sec. 4)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from minislam.errors import InputError
from minislam.evaluation.images import auroc, depth_l1, psnr, ssim
from minislam.evaluation.trajectory import (
    absolute_trajectory_error,
    oriented_truth_to_estimate,
    paired,
    straight_line_error,
)
from minislam.geometry.alignment import umeyama
from minislam.records import GroundTruth, Trajectory

MAX_DIFFERENCE = 0.02  # second between a frame and its true pose; TUM stamps differ by 0.005
Render = Callable[[np.ndarray], np.ndarray]  # T_world_camera (4, 4) -> RGB (H, W, 3)
ImageDistance = Callable[[np.ndarray, np.ndarray], float]  # rendered, true (H, W, 3) RGB
MIN_MASK = 20  # px of dynamic objects below which a view does not measure ghosts
CENTIMETRES = 100.0  # per world unit of the truth, which is metric
FAR_WORSE = 6.0  # dB below the median of all views: twice as large an error


@dataclass(frozen=True)
class MappedView:
    """The map at the end of a run, seen from the pose of one of its images."""

    frame_index: int
    color: np.ndarray  # (H, W, 3) rendered, in [0, 1]
    depth: np.ndarray | None = None  # (H, W) rendered z in units of the map, 0 where transparent
    beta: np.ndarray | None = None  # (H, W), None if no beta was learned
    static_psnr: float | None = None  # [dB] against the image itself where beta finds it static


def measure_run(
    truth: GroundTruth | None,
    trajectory: Trajectory,
    keyframe_trajectory: Trajectory,
    views: Iterable[MappedView],  # one by one: each is let go before the next
    render: Render,
    lpips: ImageDistance | None = None,  # needs weights; without it two metrics are left out
) -> dict[str, float | None]:
    """Return the metrics by name, units in the names; None for what cannot be known."""
    names = [
        "ate_all_cm", "ate_keyframes_cm", "ate_straight_line_cm", "psnr_novel_db", "ssim_novel",
        "psnr_novel_oriented_db", "psnr_input_db", "psnr_masked_db", "beta_auroc", "depth_l1_cm",
        "psnr_static_db", "far_worse",
    ]  # fmt: skip
    names += ["lpips_novel", "lpips_input"] if lpips is not None else []
    metrics: dict[str, float | None] = dict.fromkeys(names)
    errors: list[tuple[str, float]] = []  # of single views, to be averaged by name
    scale = None
    if truth is not None and (path := truth.trajectory) is not None:
        metrics["ate_all_cm"] = ate_cm(trajectory, path)
        metrics["ate_keyframes_cm"] = ate_cm(keyframe_trajectory, path)
        if metrics["ate_all_cm"] is not None:
            estimate, path = paired(trajectory, path, MAX_DIFFERENCE)
            metrics["ate_straight_line_cm"] = CENTIMETRES * straight_line_error(path)
            scale = umeyama(estimate.centres, path.centres).scale
            errors += _novel_errors(truth.novel_views(), estimate, path, render, lpips)
    betas: list[tuple[np.ndarray, np.ndarray]] = []  # with the true masks
    for view in views:
        if view.static_psnr is not None:
            errors.append(("psnr_static_db", view.static_psnr))
        if truth is None:
            continue
        moving = truth.moving_mask(view.frame_index)
        errors += _view_errors(view, truth, moving, scale, lpips)
        if view.beta is not None and moving is not None:
            betas.append((view.beta, moving))
    for name in names:
        if found := [value for of, value in errors if of == name]:
            metrics[name] = float(np.mean(found))
    if static := [value for of, value in errors if of == "psnr_static_db"]:
        metrics["far_worse"] = float(np.mean(np.array(static) < np.median(static) - FAR_WORSE))
    if betas:  # over all images of the map
        beta, masks = (np.stack(parts) for parts in zip(*betas, strict=True))
        if masks.any() and not masks.all():  # else there is nothing to separate
            metrics["beta_auroc"] = auroc(beta, masks)
    return metrics


def ate_cm(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Return the ATE [cm], None where nothing can be aligned."""
    try:
        error = absolute_trajectory_error(estimate, truth, max_difference=MAX_DIFFERENCE)
    except InputError:
        return None  # too few poses in common, or a camera that never moved: nothing to align
    return CENTIMETRES * error.statistics["rmse"]


def _novel_errors(
    views: list[tuple[np.ndarray, np.ndarray]],  # T_world_camera, image
    estimate: Trajectory,  # (N) as the path, paired
    path: Trajectory,  # (N) true
    render: Render,
    lpips: ImageDistance | None,
) -> Iterator[tuple[str, float]]:
    """Compare held-out static views with renderings from their Sim(3)-aligned poses."""
    if not views:
        return
    # As the paper, by camera centres, but into the world of the map, where the error counts; and
    # by the orientations, too, so that errors of the alignment count less.
    by_centres = umeyama(path.centres, estimate.centres)
    by_cameras = oriented_truth_to_estimate(estimate, path)
    for pose, image in views:
        rendered = render(by_centres.transform_poses(pose))
        yield "psnr_novel_db", psnr(rendered, image)
        yield "ssim_novel", ssim(rendered, image)
        if lpips is not None:
            yield "lpips_novel", lpips(rendered, image)
        rendered = render(by_cameras.transform_poses(pose))
        yield "psnr_novel_oriented_db", psnr(rendered, image)


def _view_errors(
    view: MappedView,
    truth: GroundTruth,
    moving: np.ndarray | None,  # (H, W) true mask of the view
    scale: float | None,  # of the truth per unit of the map, None: unknown
    lpips: ImageDistance | None,
) -> Iterator[tuple[str, float]]:
    """Compare the map, seen from one of its images, with image and depth of the static scene."""
    static = truth.static_image(view.frame_index)
    if static is not None:
        yield "psnr_input_db", psnr(view.color, static)
        if lpips is not None:
            yield "lpips_input", lpips(view.color, static)
        if moving is not None and moving.sum() >= MIN_MASK:  # a dynamic object's ghost is there
            yield "psnr_masked_db", psnr(view.color, static, moving)
    if scale is None or view.depth is None:
        return
    depth = truth.depth(view.frame_index)
    error = None if depth is None else depth_l1(view.depth, depth, scale, moving)
    if error is not None:
        yield "depth_l1_cm", CENTIMETRES * error
