"""What the notebooks borrow: the true flow is the one that the truth explains."""

import numpy as np
import pytest

from data_synth import generate
from data_synth.lessons import KnownViews, flow_of_cells, known_clip, known_views, of_cells
from data_synth.poses import default_intrinsics

STRIDE = 4
CAMERA = default_intrinsics((64, 48))


@pytest.fixture(scope="module")
def views() -> KnownViews:
    return known_views("crowd", [1.4, 1.5, 1.6], CAMERA)


def test_the_first_camera_is_the_world(views: KnownViews):
    assert np.allclose(views.T_world_camera[0], np.eye(4))
    assert np.abs(views.T_world_camera[1] - np.eye(4)).max() > 1e-3
    assert views.rgb.shape == (3, 48, 64, 3)
    assert 0 < views.masks.mean() < 0.8


@pytest.mark.slow
def test_a_clip_has_the_frames_of_the_generated_sequence():
    clip, sequence = known_clip("table2", [0, 2], (32, 24)), generate("table2", 0, 3, (32, 24))
    assert np.array_equal(clip.rgb, sequence.rgb[::2])
    assert np.array_equal(clip.depth, sequence.depth[::2])
    first, _, third = sequence.T_world_camera
    assert np.allclose(first @ clip.T_world_camera[1], third)


def test_cells_are_every_so_manieth_pixel_row_by_row(views: KnownViews):
    cells = of_cells(views.depth, STRIDE)
    assert cells.shape == (3, 12 * 16)
    assert cells[1, 16 + 2] == views.depth[1, STRIDE, 2 * STRIDE]


def test_from_a_view_to_itself_nothing_flows(views: KnownViews):
    flow = flow_of_cells(views, [1], [1], STRIDE)[0].reshape(12, 16, 2)
    assert np.allclose(flow[2, 3], [3 * STRIDE, 2 * STRIDE])


def test_a_static_cell_has_the_depth_that_the_target_sees(views: KnownViews):
    # The depth in the target of a point of the source is what the ray-caster sees there.
    flow = flow_of_cells(views, [0], [2], STRIDE)[0]
    columns, rows = np.round(flow).astype(int).T
    inside = (columns >= 0) & (columns < 64) & (rows >= 0) & (rows < 48)
    back = flow_of_cells(views, [2], [0], 1)[0].reshape(48, 64, 2)
    pixels = np.stack(np.meshgrid(np.arange(0, 64, STRIDE), np.arange(0, 48, STRIDE)), -1)
    off = back[rows[inside], columns[inside]] - pixels.reshape(-1, 2)[inside]
    assert np.median(np.linalg.norm(off, axis=1)) < 1.0  # rounded to a pixel


def test_only_movers_walk_and_along_the_first_axis(views: KnownViews):
    still = flow_of_cells(views, [0], [1], STRIDE)[0]
    difference = flow_of_cells(views, [0], [1], STRIDE, walk=1.0)[0] - still
    moved = np.abs(difference).max(1) > 1e-9
    assert np.array_equal(moved, of_cells(views.masks, STRIDE)[0] > 0)
    assert difference[moved, 0].min() > 0
