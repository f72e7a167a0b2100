"""Figures (matplotlib, no window needed) and the HTML report of a run."""

from minislam.viz.figures import (
    Figure,
    ate_over_time,
    keyframe_health,
    loss_curves,
    map_growth,
    overview,
    trajectory_plot,
)
from minislam.viz.pages import Page, Report, build_report, build_viewer, flipbook, summary_html
from minislam.viz.style import (
    beta_limits,
    beta_to_rgb,
    colour_bar,
    depth_limits,
    depth_to_rgb,
    figure_picture,
    figure_png,
    new_figure,
    set_notebook_style,
    show_image,
    show_map,
)

__all__ = [
    "Figure", "Page", "Report", "ate_over_time", "beta_limits", "beta_to_rgb", "build_report",
    "build_viewer", "colour_bar", "depth_limits", "depth_to_rgb", "figure_picture", "figure_png",
    "flipbook", "keyframe_health", "loss_curves", "map_growth", "new_figure", "overview",
    "set_notebook_style", "show_image", "show_map", "summary_html", "trajectory_plot",
]  # fmt: skip
