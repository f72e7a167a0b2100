"""Colours of depth and uncertainty, bytes that do not change, and windows on a screen."""

import numpy as np
import pytest
from matplotlib import colormaps, pyplot

from minislam.errors import InputError
from minislam.viz import (
    beta_to_rgb,
    depth_to_rgb,
    figure_png,
    new_figure,
    show_figure,
    show_image,
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


# Identities


def test_the_same_figure_gives_the_same_bytes():
    def draw() -> bytes:
        figure = new_figure((2, 2))
        show_image(figure.subplots(), np.zeros((4, 6, 3)), "beta")
        return figure_png(figure)

    png = draw()
    assert png == draw()
    assert png.startswith(b"\x89PNG") and b"Software" not in png


# Degenerate input


@pytest.mark.parametrize("value", [0.0, 1.0, 1e-30, np.nan])
def test_constant_maps_can_be_coloured(value: float):
    assert np.isfinite(depth_to_rgb(np.full((3, 4), value))).all()
    if np.isfinite(value):
        assert np.isfinite(beta_to_rgb(np.full((3, 4), value))).all()


# Windows


def test_without_a_display_the_user_is_told_what_to_do(monkeypatch):
    monkeypatch.setattr(pyplot, "get_backend", lambda: "agg")
    with pytest.raises(InputError, match="--save_plot"):
        show_figure(new_figure((2, 2)))


def test_with_a_display_the_figure_is_shown(monkeypatch):
    shown = []
    monkeypatch.setattr(pyplot, "get_backend", lambda: "QtAgg")
    monkeypatch.setattr(pyplot, "show", lambda: shown.extend(pyplot.get_fignums()))
    show_figure(new_figure((2, 2)))
    assert len(shown) == 1
    pyplot.close("all")
