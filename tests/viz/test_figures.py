"""Every kind of figure is drawn, says its units, and leaves no window behind."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure

from minislam.records import Trajectory
from minislam.viz import (
    ate_over_time,
    figure_png,
    keyframe_health,
    loss_curves,
    map_growth,
    overview,
    trajectory_plot,
)

pytestmark = pytest.mark.slow

IMAGE, DEPTH = np.full((24, 32, 3), 0.5), np.linspace(0, 3, 24 * 32).reshape(24, 32)
BETA = np.ones((3, 4))


def path(count: int) -> Trajectory:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(count, 3))
    return Trajectory(np.arange(float(count)), poses)


FIGURES = {
    "trajectory": lambda: trajectory_plot(path(9), path(20), "m"),
    "trajectory without truth": lambda: trajectory_plot(path(9)),
    "one pose": lambda: trajectory_plot(path(1)),
    "no pose": lambda: trajectory_plot(path(0)),
    "ate": lambda: ate_over_time(np.arange(5.0), np.arange(5.0)),
    "losses": lambda: loss_curves({"render": [3, 2, 1], "uncertainty": [0.0, -1]}),
    "losses with pauses": lambda: loss_curves({"uncertainty": [1.0, np.nan, -1.0, np.nan]}),
    "growth": lambda: map_growth([10, 30, 20]),
    "health": lambda: keyframe_health(
        [0, 4, 9], [None, 0.9, 0.3], [None, 1, 0.2], 0.8, [(9, 12)], [13, 14]
    ),
    "empty map": lambda: map_growth([]),
    "no losses": lambda: loss_curves({}),
    "overview": lambda: overview(IMAGE, BETA, IMAGE, path(9), path(9)),
    "overview without pose": lambda: overview(IMAGE, BETA, IMAGE, path(0)),
}


@pytest.mark.parametrize("kind", FIGURES)
def test_figures_are_drawn(kind: str):
    png = figure_png(FIGURES[kind](), dpi=40)
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.std() > 1


def test_axes_carry_units_and_truth_is_black_dashed():
    figure: Figure = FIGURES["trajectory"]()
    assert [axes.get_xlabel() for axes in figure.axes] == ["x [m]", "x [m]"]
    assert [axes.get_ylabel() for axes in figure.axes] == ["z [m]", "y [m]"]
    truth = figure.axes[0].lines[0]
    assert (truth.get_color(), truth.get_linestyle()) == ("black", "--")
    assert FIGURES["ate"]().axes[0].get_xlabel() == "time [s]"
    (rmse,) = FIGURES["ate"]().axes[0].get_legend().get_texts()
    assert rmse.get_text() == "rmse 2.45 world units"


@pytest.mark.parametrize(("height", "ground"), [(1, "z"), (2, "y")])
def test_an_overview_shows_the_path_from_above(height: int, ground: str):
    level = path(9)
    level.T_world_camera[:, height, 3] *= 0.1
    for estimate, truth in ((level, None), (path(9), level)):
        panel = overview(IMAGE, BETA, IMAGE, estimate, truth).axes[3]
        assert panel.get_ylabel() == f"{ground} [world units]"
        places = level.centres[:, [0, "xyz".index(ground)]]
        np.testing.assert_array_equal(panel.lines[0].get_xydata(), places)


def test_the_legend_of_the_health_hides_no_frame():
    figure = FIGURES["health"]()
    figure.draw_without_rendering()
    (axes,) = figure.axes
    assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1


def test_losses_of_both_signs_have_a_linear_panel_of_their_own():
    figure = loss_curves({"L_render": [3.0, 2.0, 1.0], "L_uncer": [0.5, np.nan, -1.0]})
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "linear"]
    mean = figure.axes[1].lines[1]
    np.testing.assert_allclose(mean.get_xydata(), [[0, 0.5], [2, -0.25]])  # the pause is left out


def test_labels_of_a_short_path_do_not_overlap():
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :2, 3] = np.linspace(0, -0.01, 9)[:, None]
    figure = trajectory_plot(Trajectory(np.arange(9.0), poses))
    figure_png(figure)  # places the labels
    for axes in figure.axes:
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))


def test_figures_do_not_touch_the_state_of_pyplot():
    FIGURES["overview"]()
    assert pyplot.get_fignums() == []


def test_a_break_is_red_from_the_pose_before_to_the_pose_after():
    whole, cuts = path(9), [(3.0, 4.0), (8.0, 8.0)]
    both = trajectory_plot(whole, None, "m", cuts), overview(IMAGE, BETA, IMAGE, whole, broken=cuts)
    for figure in both:
        _, first, last = figure.axes[-1 if figure is both[0] else 3].lines
        second = 1 if figure is both[0] else 2
        for line, part in ((first, slice(2, 6)), (last, slice(7, 9))):
            places = whole.T_world_camera[part, :3, 3]
            np.testing.assert_array_equal(line.get_xydata(), places[:, [0, second]])
            assert line.get_color() == "tab:red"
        legend = first.axes.get_legend().get_texts()
        assert [text.get_text() for text in legend] == ["estimate", "broken"]


def test_a_path_of_no_length_is_a_point():
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    for estimate, marker, label in (
        (still, "o", "estimate (stands)"),
        (path(1), "o", "estimate (stands)"),
        (path(3), "None", "estimate"),
    ):
        for axes in trajectory_plot(estimate).axes:
            (line,) = axes.lines
            assert (line.get_marker(), line.get_label()) == (marker, label)
