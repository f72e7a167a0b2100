"""Figures (matplotlib, no window needed) and the HTML report of a run."""

from minislam.viz.figures import (
    Figure,
    ate_over_time,
    keyframe_health,
    keyframe_strip,
    loss_curves,
    map_growth,
    online_uncertainty,
    overview,
    trajectory_plot,
)
from minislam.viz.notebook import Page, summary_html
from minislam.viz.report import Report, build_report
from minislam.viz.style import (
    beta_limits,
    beta_to_rgb,
    depth_limits,
    depth_to_rgb,
    figure_png,
    new_figure,
    show_figure,
    show_image,
)
from minislam.viz.viewer import build_viewer, picture_url

__all__ = [
    "Figure",
    "Page",
    "Report",
    "ate_over_time",
    "beta_limits",
    "beta_to_rgb",
    "build_report",
    "build_viewer",
    "depth_limits",
    "depth_to_rgb",
    "figure_png",
    "keyframe_health",
    "keyframe_strip",
    "loss_curves",
    "map_growth",
    "new_figure",
    "online_uncertainty",
    "overview",
    "picture_url",
    "show_figure",
    "show_image",
    "summary_html",
    "trajectory_plot",
]
