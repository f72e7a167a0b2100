"""Colours of depth and uncertainty, and bytes that do not change."""

import numpy as np
import pytest
from matplotlib import colormaps, pyplot, rc_context

from minislam.viz import (
    beta_to_rgb,
    colour_bar,
    depth_to_rgb,
    figure_picture,
    figure_png,
    new_figure,
    set_notebook_style,
    show_image,
    show_map,
)

# Known answers


def test_depth_runs_through_viridis_and_unknown_is_grey():
    colored = depth_to_rgb(np.array([[0.0, 1.0], [2.0, 3.0]]), limits=(1, 3))
    np.testing.assert_allclose(colored[0, 0], 0.25)
    np.testing.assert_allclose(colored[0, 1], colormaps["viridis"](0.0)[:3])
    np.testing.assert_allclose(colored[1, 1], colormaps["viridis"](1.0)[:3])


def test_beta_is_shown_by_its_logarithm():
    colored = beta_to_rgb(np.array([[1.0, 10.0, 100.0]]), limits=(1, 100))
    np.testing.assert_allclose(colored[0, 1], colormaps["magma"](0.5)[:3])


def test_the_noise_of_a_still_scene_stays_dark():
    beta = 1 + 0.01 * np.random.default_rng(0).random((6, 8))
    assert beta_to_rgb(beta).mean() < 0.1


def test_what_the_map_shows_is_not_bright():
    beta = np.geomspace(0.1, 0.4, 48).reshape(6, 8)  # of a plain floor, where nothing moves
    assert beta_to_rgb(beta).max() < 0.8
    beta[0, 0] = 1.5
    assert beta_to_rgb(beta)[0, 0].max() > 0.95


@pytest.mark.parametrize("kind, limits", [("depth", (1, 3)), ("weight", (0, 1)), ("beta", (1, 9))])
def test_a_colour_bar_has_the_colours_and_the_limits_of_its_kind(kind, limits):
    figure = new_figure((3, 2))
    axes = figure.subplots(1, 2)
    colour_bar(axes, kind, limits)
    bar = figure.axes[-1]
    assert bar.get_ylim() == pytest.approx(limits) and bar.get_ylabel() == kind
    assert bar.get_yscale() == ("log" if kind == "beta" else "linear")


def test_a_map_of_errors_is_white_at_zero_and_red_above():
    figure = new_figure((2, 2))
    show_map(axes := figure.subplots(), np.array([[-2.0, 0.0, 2.0]]), "error", "t", label="cm")
    left, middle, right = np.asarray(axes.images[0].get_array())[0]
    assert middle.min() > 0.95 and right[0] > right[2] and left[2] > left[0]
    (bar,) = axes.child_axes
    assert bar.get_ylim() == (-2, 2) and bar.get_ylabel() == "cm"


@pytest.mark.parametrize("kind", ["beta", "depth"])
def test_maps_look_as_without_a_bar(kind: str):
    values = np.random.default_rng(0).uniform(1, 9, (4, 5))
    show_map(axes := new_figure((2, 2)).subplots(), values, kind, "t")
    drawn = np.asarray(axes.images[0].get_array())
    np.testing.assert_array_equal(drawn, {"beta": beta_to_rgb, "depth": depth_to_rgb}[kind](values))


def test_figures_of_pyplot_are_as_sharp_as_ours():
    with rc_context():
        set_notebook_style()
        assert figure_picture(pyplot.figure(figsize=(2, 1))).shape == (110, 220, 3)
    pyplot.close("all")


# Identities


def test_the_same_figure_gives_the_same_bytes():
    def draw() -> bytes:
        figure = new_figure((2, 2))
        show_image(figure.subplots(), np.zeros((4, 6, 3)), "beta")
        return figure_png(figure)

    png = draw()
    assert png == draw()
    assert png.startswith(b"\x89PNG") and b"Software" not in png


def test_the_noise_of_a_backdrop_does_not_fill_the_colours_of_depth():
    depth = 1 + 0.01 * np.random.default_rng(0).random((8, 8))
    spread = np.ptp(depth_to_rgb(depth), axis=(0, 1)).max()
    assert 0 < spread < 0.2 < np.ptp(depth_to_rgb(10 * depth**70), axis=(0, 1)).max()


# Degenerate input


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-30, np.nan])
def test_constant_maps_can_be_coloured(value: float):
    assert np.isfinite(depth_to_rgb(np.full((3, 4), value))).all()
    if np.isfinite(value):
        assert np.isfinite(beta_to_rgb(np.full((3, 4), value))).all()


def test_the_colours_of_depth_do_not_depend_on_the_unit():
    depth = np.linspace(0.0, 3.0, 48).reshape(6, 8)
    for unit in (0.01, 100.0):
        np.testing.assert_allclose(depth_to_rgb(unit * depth), depth_to_rgb(depth), atol=0.01)
