"""The figures of runs, reports and notebooks: one function per kind, each returns a Figure."""

from collections.abc import Mapping
from collections.abc import Sequence as Series
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from minislam.records import Trajectory
from minislam.viz.style import ESTIMATE_STYLE, TRUTH_STYLE, beta_to_rgb, new_figure, show_image

Breaks = Series[tuple[float, float]]  # first and last time of each [s]
_NO_LENGTH = 1e-9  # units of the path; a shorter line cannot be seen
_AVERAGED = 30  # iterations in the running mean of a loss


def trajectory_plot(
    estimate: Trajectory,
    truth: Trajectory | None = None,
    unit: str = "world units",
    broken: Breaks = (),
) -> Figure:
    """Draw camera centres in the planes x-z and x-y; the estimate must be aligned already."""
    figure = new_figure()
    for axes, second in zip(figure.subplots(1, 2), (2, 1), strict=True):
        _draw_path(axes, estimate, truth, second, unit, broken)
    figure.draw_without_rendering()  # equal scales change the ticks, for which there must be room
    return figure


def ate_over_time(timestamps: np.ndarray, errors: np.ndarray, unit: str = "world units") -> Figure:
    """Draw the distances (N,) between estimated and true camera centre over time (N,) [s]."""
    figure, axes = _one_panel("time [s]", f"position error [{unit}]")
    axes.plot(timestamps - timestamps[0], errors, color=ESTIMATE_STYLE["color"])
    rmse = float(np.sqrt(np.mean(np.square(errors))))
    axes.axhline(rmse, color="tab:red", linewidth=1, label=f"rmse {rmse:.3g} {unit}")
    axes.set_ylim(0, 1.1 * float(np.max(errors, initial=np.finfo(float).eps)))
    axes.legend(frameon=False)
    return figure


def loss_curves(history: Mapping[str, Series[float]]) -> Figure:
    """Draw losses per iteration: on a logarithmic scale if always positive, else on a linear one.

    The values jump because each iteration renders another keyframe; the thick line is their
    running mean. NaN marks iterations without training and is left out.
    """
    curves = {name: np.asarray(values, dtype=np.float64) for name, values in history.items()}
    logarithmic = {n: v for n, v in curves.items() if np.all(v[np.isfinite(v)] > 0)}
    linear = {n: v for n, v in curves.items() if n not in logarithmic}
    figure = new_figure()
    panels = [panel for panel in (logarithmic, linear) if panel] or [{}]
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for number, (name, values) in enumerate(panel.items()):
            shown = np.flatnonzero(np.isfinite(values))
            color = f"C{number}" if panel is logarithmic else "C2"
            axes.plot(shown, values[shown], color=color, linewidth=0.5, alpha=0.3)
            axes.plot(shown, _running_mean(values[shown]), color=color, label=name)
        axes.set(xlabel="iteration", ylabel="loss")
        if panel is logarithmic and any(len(values) for values in panel.values()):
            axes.set_yscale("log")
        if panel:
            axes.legend(frameon=False, fontsize=8)
        axes.grid(alpha=0.3)
    return figure


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of each value and up to _AVERAGED - 1 values before it."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    start = np.maximum(0, end - _AVERAGED)
    return (total[end] - total[start]) / (end - start)


def map_growth(gaussians: Series[float]) -> Figure:
    """Draw the number of Gaussians in the map over the iterations."""
    figure, axes = _one_panel("iteration", "Gaussians in the map")
    axes.plot(np.arange(len(gaussians)), gaussians, color=ESTIMATE_STYLE["color"])
    axes.set_ylim(0, 1.1 * max([1, *gaussians]))
    return figure


def keyframe_health(
    frames: Series[int],  # (K,) frame_index of the keyframes
    explained: Series[float | None],  # (K,) part of the flow that poses and disparities explain [-]
    agreement: Series[float | None],  # (K,) part that fits of the cells that fitted before [-]
    least: float,  # of a healthy keyframe
    broken: Series[tuple[int, int]],  # first and last frame
    lost: Series[int],  # frame_index
) -> Figure:
    """Draw how well poses and depths explain the flow, and where the run is broken or lost."""
    figure, axes = _one_panel("frame", "explained flow", height=2.2)
    of_all, of_held = np.array([explained, agreement], dtype=np.float64)  # None becomes NaN
    axes.plot(frames, of_all, marker=".", label="of all flow", **ESTIMATE_STYLE)
    axes.plot(frames, of_held, "--", color="tab:purple", label="of what held the camera before")
    axes.axhline(least, color="gray", linestyle=":", label="least of a healthy keyframe")
    for position, (first, last) in enumerate(broken):
        label = "broken" if position == 0 else None
        axes.axvspan(first - 0.5, last + 0.5, color="tab:red", alpha=0.25, label=label)
    mark: dict[str, Any] = {"color": "tab:red", "markersize": 14, "markeredgewidth": 3}
    axes.plot(lost, np.zeros(len(lost)), "|", label="lost" if len(lost) else None, **mark)
    axes.set(xlim=(-0.5, max([1, *frames, *lost]) + 0.5), ylim=(-0.05, 1.05))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=5, frameon=False, fontsize=8)
    return figure


def overview(
    image: np.ndarray,  # (H, W, 3) RGB in [0, 1]
    beta: np.ndarray,  # (h, w) > 0
    render: np.ndarray,  # (H, W, 3) RGB
    estimate: Trajectory,
    truth: Trajectory | None = None,
    unit: str = "world units",
    broken: Breaks = (),
) -> Figure:
    """Draw a run in one picture: input, uncertainty, static render, trajectory from above.

    The ground is x-z for an estimate, and x-y where a truth turns it upright: the wider plane.
    """
    figure = new_figure((12.0, 2.6))
    axes = figure.subplots(1, 4)
    show_image(axes[0], image, "input frame")
    show_image(axes[1], beta_to_rgb(beta), "uncertainty beta", image.shape[:2])
    show_image(axes[2], render, "static map, same view")
    centres = (truth or estimate).centres
    _, y, z = np.abs(centres - centres[:1]).max(axis=0, initial=0)  # how far the path goes
    _draw_path(axes[3], estimate, truth, 2 if z >= y else 1, unit, broken)
    return figure


def _one_panel(xlabel: str, ylabel: str, height: float = 3.0) -> tuple[Figure, Axes]:
    figure = new_figure((9.0, height))
    axes = figure.subplots()
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)
    return figure, axes


def _draw_path(
    axes: Axes, estimate: Trajectory, truth: Trajectory | None, axis: int, unit: str, broken: Breaks
) -> None:
    """Draw x against y (axis 1) or z (axis 2) at one scale; breaks, with ends, are red."""
    paths = [(truth, "ground truth", TRUTH_STYLE), (estimate, "estimate", ESTIMATE_STYLE)]
    for path, label, style in paths:
        if path is not None:
            centres = path.centres
            stands = len(centres) > 0 and bool((np.ptp(centres, axis=0) < _NO_LENGTH).all())
            name = {"marker": "o", "label": f"{label} (stands)"} if stands else {"label": label}
            axes.plot(centres[:, 0], centres[:, axis], **style | name)
    for position, (first, last) in enumerate(broken):
        times, name = estimate.timestamps, {"label": "" if position else "broken"}
        part = slice(max(0, np.sum(times < first) - 1), np.sum(times <= last) + 1)
        x, _, _ = places = estimate.centres[part].T
        axes.plot(x, places[axis], **ESTIMATE_STYLE | name | {"color": "tab:red"})
    axes.set(xlabel=f"x [{unit}]", ylabel=f"{'xyz'[axis]} [{unit}]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.locator_params(nbins=5)  # labels of short paths are long
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=8)
