"""The mask M against the stored answer of the official function (tests/data/tracking/README.md)."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.tracking.config import TrackingConfig
from minislam.tracking.disparity_prior import DepthView, depth_consistency, prior_mask
from minislam.tracking.grid import Grid
from tests.helpers import random_transforms
from tests.tracking.golden import transforms_of
from tests.tracking.scene import STRIDE

CONFIG = TrackingConfig(prior_mask=True)
EPSILON, GAMMA = 0.02, 0.9  # paper


@cache
def official() -> dict[str, Tensor]:
    file = Path(__file__).parents[1] / "data" / "tracking" / "official_mask.npz"
    with np.load(file) as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files}


def official_views() -> tuple[Grid, DepthView, list[DepthView]]:
    o = official()
    camera = Camera(*o["K"].tolist(), width=84, height=56)
    disparities = o["mono_disp"].double()
    depths = torch.where(disparities > 0, disparities.reciprocal(), 0)
    poses = transforms_of(o["poses"])
    order = [int(o["idx"]), *o["refs"].tolist()]
    ours, *others = [DepthView(depths[k], o["feats"][k].double(), poses[k]) for k in order]
    return Grid.of(camera, 1), ours, others


def points_per_pixel() -> Tensor:  # (H W,)
    """Return the largest number of points that one view puts on each pixel."""
    grid, ours, others = official_views()
    largest = torch.zeros(len(grid.pixels), dtype=torch.int64)
    for other in others:
        depth = other.metric_depth.reshape(-1)
        known = depth > 0
        points = grid.camera.backproject(grid.pixels.double(), depth)[known]
        motion = ours.T_camera_world @ torch.linalg.inv(other.T_camera_world)
        u, v = grid.camera.project(points @ motion[:3, :3].T + motion[:3, 3]).round().T
        inside = (u >= 0) & (u < 84) & (v >= 0) & (v < 56)
        index = (84 * v + u)[inside].long()
        largest = largest.maximum(torch.bincount(index, minlength=len(largest)))
    return largest


def test_counts_equal_the_official_ones_where_a_view_puts_at_most_one_point():
    grid, ours, others = official_views()
    corresponding, agreeing = depth_consistency(grid, ours, others, EPSILON, GAMMA)
    comparable = (points_per_pixel() <= 1) & (ours.metric_depth.reshape(-1) > 0)
    assert comparable.double().mean() > 0.8
    consistent = official()["acc"].reshape(-1).long()
    inconsistent = official()["bad"].reshape(-1).long()
    assert torch.equal(agreeing[comparable], consistent[comparable])
    contradicting = corresponding - agreeing
    assert torch.equal(contradicting[comparable], inconsistent[comparable])


def test_the_mask_equals_the_official_one():
    """Differences on purpose, and how they are taken out of the comparison.

    * Official: at least one view contradicts and at most one agrees. Ours, as the paper says: at
      least two have a word and at most one agrees. The official rule is applied to our counts.
    * Official: of several points on a pixel the last one written counts. Ours: the nearest. That
      is the one in a thousand that may differ.
    """
    grid, ours, others = official_views()
    corresponding, consistent = depth_consistency(grid, ours, others, EPSILON, GAMMA)
    official_rule = ~((corresponding > consistent) & (consistent <= 1))
    expected = official()["mask"].reshape(-1)
    assert 0.02 < (~expected).double().mean() < 0.2
    assert (official_rule == expected).double().mean() >= 0.999
    # On these views the two rules say the same, because nearly every pixel is seen by two.
    mask = prior_mask(grid, ours, others, CONFIG)
    assert (mask == expected).double().mean() >= 0.999


# Identities


def counts_of(views: list[DepthView]) -> tuple[Tensor, Tensor]:
    grid = official_views()[0]
    return depth_consistency(grid, views[0], views[1:], EPSILON, GAMMA)


def assert_same_counts(views: list[DepthView]) -> None:
    _, ours, others = official_views()
    for actual, expected in zip(counts_of(views), counts_of([ours, *others]), strict=True):
        assert torch.equal(actual, expected)


def test_it_does_not_depend_on_where_the_world_stands():
    _, ours, others = official_views()
    move = random_transforms(1, "normal", seed=3)[0]
    assert_same_counts(
        [replace(v, T_camera_world=v.T_camera_world @ move) for v in [ours, *others]]
    )


def test_it_does_not_depend_on_the_unit_of_length():
    _, ours, others = official_views()
    unit = torch.ones(4, 4, dtype=torch.float64)
    unit[:3, 3] = 3.7
    assert_same_counts(
        [
            DepthView(3.7 * v.metric_depth, v.features, unit * v.T_camera_world)
            for v in [ours, *others]
        ]
    )


def test_it_does_not_depend_on_the_order_of_views_or_the_length_of_features():
    _, ours, others = official_views()
    longer = [replace(v, features=(2.0 + n) * v.features) for n, v in enumerate(others)]
    assert_same_counts([replace(ours, features=0.1 * ours.features), *longer[::-1]])


def test_cells_are_pixels_of_the_full_image():
    _, ours, others = official_views()
    fine, coarse = official_views()[0], Grid.of(official_views()[0].camera, STRIDE)
    every_pixel = prior_mask(fine, ours, others, CONFIG).reshape(56, 84)
    cells = prior_mask(coarse, ours, others, CONFIG).reshape(coarse.shape)
    assert torch.equal(cells, every_pixel[::STRIDE, ::STRIDE])
