"""The last tenth of a pixel: what Lucas-Kanade finds that a dense flow has left over."""

import numpy as np
import pytest

from minislam.priors import grid_flow
from minislam.priors.dense_flow import grayscale
from minislam.priors.flow import STRIDE
from minislam.priors.grid_flow import (
    lucas_kanade,
    match_exposure,
    measure_on_grid,
    texture_confidence,
    windows_of,
)
from tests.priors.patterns import HEIGHT, SIZE, WIDTH, constant, shifted, view

INNER_CELLS = (slice(2, -2), slice(2, -2))
SURE = np.ones((HEIGHT // STRIDE, WIDTH // STRIDE), np.float32)


def brought_to(source: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the other image with the exposure of the source."""
    return match_exposure(other, windows_of(source, other, STRIDE))


@pytest.mark.parametrize("shift", [(0.3, -0.2), (-0.6, 0.4), (0.0, 0.0)])
def test_a_fraction_of_a_pixel_is_found(shift: tuple[float, float]):
    source, warped = grayscale(shifted(0, 0, SIZE)), grayscale(shifted(*shift, SIZE))
    found = lucas_kanade(source, warped, STRIDE)
    assert found.shape == (HEIGHT // STRIDE, WIDTH // STRIDE, 2)
    error = found[INNER_CELLS] - shift
    assert np.abs(error.mean((0, 1))).max() < 0.01
    assert np.abs(error).max() < 0.12


def test_what_is_further_away_is_not_believed():
    source, warped = grayscale(shifted(0, 0, SIZE)), grayscale(shifted(2.5, 0, SIZE))
    found = lucas_kanade(source, warped, STRIDE)
    assert np.abs(found).max() < grid_flow.MAX_REMAINDER
    assert (found == 0).all(-1).mean() > 0.5


def test_a_flow_that_is_off_everywhere_by_the_same_is_set_right():
    # The error that turns a camera: it does not average out over the cells.
    angle = 0.05
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([WIDTH / 2, HEIGHT / 2])
    source = grayscale(shifted(0, 0, SIZE))
    target = grayscale(view(R.T, centre - R.T @ centre, SIZE))
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    truth = (np.stack([u, v], -1) - centre) @ (R - np.eye(2)).T
    off = (truth + np.array([0.25, -0.15])).astype(np.float32)
    targets, _ = measure_on_grid(source, target, off, -off, SURE, STRIDE)
    cells = np.stack([u, v], -1)[::STRIDE, ::STRIDE]
    error = (targets - cells - truth[::STRIDE, ::STRIDE])[INNER_CELLS]
    assert np.abs(error.mean((0, 1))).max() < 0.01
    assert np.abs(error).max() < 0.15


# Exposure


@pytest.mark.parametrize(("contrast", "brightness"), [(0.5, 0.2), (1.3, -0.1), (1.0, 0.0)])
def test_another_exposure_is_taken_back(contrast: float, brightness: float):
    bright = shifted(0, 0, SIZE) * 0.5 + 0.25
    other = (contrast * bright + brightness).clamp(0, 1)
    back = brought_to(grayscale(bright), grayscale(other))
    assert np.abs(back.astype(int) - grayscale(bright)).max() <= 3
    found = lucas_kanade(grayscale(bright), back, STRIDE)
    assert np.abs(found).max() < 0.15 and np.median(np.abs(found)) < 0.03


def test_covered_regions_do_not_change_the_exposure():
    source = grayscale(shifted(0, 0, SIZE))
    covered = source.copy()
    covered[:, : WIDTH // 3] = grayscale(0.4 * shifted(40, 9, SIZE))[:, : WIDTH // 3]
    back = brought_to(source, covered)
    assert np.abs(back[:, WIDTH // 2 :].astype(int) - source[:, WIDTH // 2 :]).max() <= 2


def test_an_exposure_that_nothing_tells_is_left_alone():
    blank, source = np.full(SIZE, 90, np.uint8), grayscale(shifted(0, 0, SIZE))
    assert brought_to(source, blank) is blank
    assert brought_to(blank, source) is source


# Degenerate input


@pytest.mark.parametrize("brightness", [0, 128, 255])
def test_a_bare_wall_leaves_nothing_over(brightness: int):
    wall = np.full(SIZE, brightness, np.uint8)
    assert (lucas_kanade(wall, wall, STRIDE) == 0).all()
    targets, confidence = measure_on_grid(wall, wall, constant(1, 0), constant(-1, 0), SURE, STRIDE)
    assert np.isfinite(targets).all() and (confidence == 0).all()


def test_nothing_is_changed():
    source, target = (grayscale(shifted(d, 0, SIZE)) for d in (0, 2))
    copies = source.copy(), target.copy(), constant(2, 0)
    flow = constant(2, 0)
    measure_on_grid(source, target, flow, -flow, SURE, STRIDE)
    for now, then in zip((source, target, flow), copies, strict=True):
        np.testing.assert_array_equal(now, then)


def test_stripes_locate_no_cell_and_a_pattern_of_both_locates_each():
    v, u = np.mgrid[:64, :64]
    rows, columns, slanted = (128 + 100 * np.sin(x / 2) for x in (v, u, u + v))
    for stripes in (rows, columns, slanted):
        assert texture_confidence(stripes, 8)[1:, 1:].max() < 1e-3  # not at the border
    assert texture_confidence((rows + columns) / 2, 8).min() > 0.3
