"""The pictures of a run folder: keyframe images, plots and the report."""

import numpy as np

from minislam.data import RunFolder
from minislam.evaluation import absolute_trajectory_error
from minislam.evaluation.metrics import MAX_DIFFERENCE
from minislam.runs.facts import focal_length_note
from minislam.slam import Slam
from minislam.tracking.safeguards.diagnostics import MIN_EXPLAINED_LONG
from minislam.viz import (
    ate_over_time,
    beta_to_rgb,
    build_report,
    depth_to_rgb,
    figure_png,
    keyframe_health,
    keyframe_strip,
    loss_curves,
    map_growth,
    overview,
    trajectory_plot,
)

MAX_STRIPS = 6  # keyframes shown in the report


def write_pictures(
    folder: RunFolder, slam: Slam, metrics: dict[str, float | None], warnings: list[str]
) -> None:
    """Write keyframe images, plots and the report."""
    estimate, true_path, unit = slam.trajectory(), None, "world units"
    plots: dict[str, tuple[str, bytes]] = {}  # caption and PNG, by name
    truth = slam.sequence.ground_truth
    if metrics["ate_all_cm"] is not None and truth is not None and truth.trajectory is not None:
        error = absolute_trajectory_error(estimate, truth.trajectory, max_difference=MAX_DIFFERENCE)
        estimate, true_path, unit = error.estimate, error.truth, "m"
        over_time = figure_png(ate_over_time(estimate.timestamps, error.errors, unit))
        plots["ate_over_time"] = "Error over time", over_time
    plots["trajectory"] = "Trajectory", figure_png(trajectory_plot(estimate, true_path, unit))
    history = slam.mapper.history
    curves = {"L_render": history.render, "L_color": history.color, "L_uncer": history.uncertainty}
    plots["losses"] = "Losses", figure_png(loss_curves(curves))
    plots["gaussians"] = "Size of the map", figure_png(map_growth(history.gaussians))
    plots["health"] = "Do motion and depth explain the flow?", _health(slam)
    for name, (_, png) in plots.items():
        folder.write_plot(name, png)

    strips = _write_keyframes(folder, slam)
    middle = len(slam.mapper.keyframes) // 2
    keyframe, beta = slam.mapper.keyframes[middle], slam.beta_image(middle)
    color = slam.mapper.render(keyframe.T_camera_world).color.clamp(0, 1).numpy()
    picture = overview(keyframe.image.numpy(), beta, color, estimate, true_path, unit)
    folder.write_plot("overview", figure_png(picture))
    summary = {"focal_length": focal_length_note(slam)}
    summary |= {name: _shown(value) for name, value in metrics.items()}
    figures = [plots.pop("trajectory"), *strips, *plots.values()]
    title = f"minislam: {slam.sequence.name}"
    folder.write_report(build_report(title, summary, warnings, figures))


def _health(slam: Slam) -> bytes:
    diagnostics = slam.tracker.watch.diagnostics
    figure = keyframe_health(
        [keyframe.frame_index for keyframe in diagnostics],
        [keyframe.explained for keyframe in diagnostics],
        MIN_EXPLAINED_LONG,
        [(found.first_frame, found.last_frame) for found in slam.tracker.watch.breaks],
        [index for index, _, _ in slam.lost_frames()],
    )
    return figure_png(figure)


def _write_keyframes(folder: RunFolder, slam: Slam) -> list[tuple[str, bytes]]:
    """Write the pictures of all keyframes; return some of them as strips with captions."""
    strips: list[tuple[str, bytes]] = []
    count = len(slam.mapper.keyframes)
    shown = set(np.linspace(0, count - 1, min(MAX_STRIPS, count)).round().astype(int).tolist())
    for index, keyframe in enumerate(slam.mapper.keyframes):
        rendering = slam.mapper.render(keyframe.T_camera_world)
        image, beta = keyframe.image.numpy(), slam.beta_image(index)
        color, depth = rendering.color.clamp(0, 1).numpy(), rendering.depth.numpy()
        number = keyframe.frame_index
        folder.write_keyframe_image(number, "input", image)
        folder.write_keyframe_image(number, "render", color)
        folder.write_keyframe_image(number, "depth", depth_to_rgb(depth))
        folder.write_keyframe_image(number, "beta", beta_to_rgb(beta))
        if index in shown:
            strip = figure_png(keyframe_strip(image, depth, beta, color, f"frame {number}"))
            strips.append((f"Keyframe {index}, frame {number}", strip))
    return strips


def _shown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
