import math
from dataclasses import replace

import torch

from minislam.geometry import Camera
from minislam.mapping.config import DensityConfig
from minislam.mapping.density import densify, screen_gradients, split, useful_rows
from minislam.splatting import GaussianMap, LearningRates, MapOptimizer
from tests.helpers import generator

CONFIG = DensityConfig(max_gaussians=10000)
HERE = torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)  # T_camera_world of six keyframes


def map_of(scales: list[float], opacity_logit: float = 2.0) -> GaussianMap:
    count = len(scales)
    return GaussianMap(
        torch.arange(count * 3.0).reshape(count, 3),
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).clone(),
        torch.tensor(scales).log()[:, None].expand(count, 3).clone(),
        torch.full((count,), opacity_logit),
        torch.full((count, 3), 0.5),
        torch.arange(count),
    )


def over_three_views(means: torch.Tensor) -> torch.Tensor:
    return torch.stack([3 * means, torch.full_like(means, 3)])


# Known answers


def test_screen_gradient_is_in_half_images_and_counts_only_views_that_see():
    camera = Camera(10.0, 10.0, 4.0, 2.0, 20, 10)
    weight_sums = torch.tensor([2.0, 0.0])
    first = screen_gradients(torch.tensor([[0.3, 0.4], [1.0, 1.0]]), weight_sums, camera)
    # |(0.3 * 10, 0.4 * 5)| = sqrt(13).
    torch.testing.assert_close(first, torch.tensor([[13**0.5, 0.0], [1.0, 0.0]]))


def test_small_ones_are_cloned_and_large_ones_split():
    optimizer = MapOptimizer(map_of([0.01, 0.01, 0.5]), LearningRates())
    gradients = over_three_views(torch.tensor([1.0, 0.0, 1.0]))
    densify(optimizer, gradients, 1.0, CONFIG, generator(0))
    gaussians = optimizer.gaussians
    assert len(gaussians) == 5
    # The large one is gone; a clone and two children, with the anchors of their parents.
    assert gaussians.anchor_keyframe.tolist() == [0, 1, 0, 2, 2]
    assert torch.equal(gaussians.means[2], gaussians.means[0])
    torch.testing.assert_close(gaussians.scales[3:], torch.full((2, 3), 0.5 / 1.6))


def test_faint_huge_and_broken_gaussians_are_not_useful():
    gaussians = map_of([0.01, 0.01, 5.0, 0.01, 0.01, 0.01])
    gaussians.opacity_logits[1] = -5
    for broken, row in (("means", 3), ("quats_wxyz", 4), ("colors", 5)):
        getattr(gaussians, broken)[row, 0] = torch.nan
    assert useful_rows(gaussians, HERE, 1.0).tolist() == [True, *[False] * 5]


def test_what_is_far_from_its_keyframe_may_be_as_large_as_it_looks():
    gaussians = map_of([0.15, 0.25, 5.0, 5.0])  # 2.2, 7.1, 12.2 and 17.4 from the origin
    assert useful_rows(gaussians, HERE, 1.0).tolist() == [True, True, False, False]
    gaussians.means[2:] *= 3
    assert useful_rows(gaussians, HERE, 1.0).tolist() == [True] * 4
    there = HERE.clone()
    there[3, :3, 3] = -gaussians.means[3].double()  # its keyframe has gone where it is
    assert useful_rows(gaussians, there, 1.0).tolist() == [True, True, True, False]
    assert useful_rows(gaussians, there, 30.0).tolist() == [True] * 4


# Identities


def test_children_are_spread_like_their_parent():
    parents = map_of([1.0] * 4000)
    parents.means.zero_()
    children = split(parents, generator(1))
    assert children.means.mean(0).abs().max() < 0.05
    torch.testing.assert_close(children.means.std(0), torch.ones(3), rtol=0.05, atol=0)


def test_no_more_than_the_largest_number_of_gaussians():
    config = replace(CONFIG, max_gaussians=6)
    optimizer = MapOptimizer(map_of([0.01] * 5), LearningRates())
    gradients = over_three_views(torch.tensor([1.0, 5.0, 2.0, 3.0, 4.0]))
    densify(optimizer, gradients, 1.0, config, generator(0))
    assert optimizer.gaussians.anchor_keyframe.tolist() == [0, 1, 2, 3, 4, 1]
    densify(optimizer, over_three_views(torch.ones(6)), 1.0, config, generator(0))
    assert len(optimizer.gaussians) == 6


# Degenerate input


def test_an_empty_map_stays_empty():
    optimizer = MapOptimizer(GaussianMap.empty(), LearningRates())
    densify(optimizer, torch.zeros(2, 0), 1.0, CONFIG, generator(0))
    assert len(optimizer.gaussians) == 0
    assert useful_rows(optimizer.gaussians, HERE, 1.0).tolist() == []


def test_children_are_those_of_the_generator_given():
    first, second = (split(map_of([1.0] * 3), generator(1)).means for _ in range(2))
    assert torch.equal(first, second)


def test_children_lie_along_the_longest_axis_of_their_parent():
    parents = map_of([1.0] * 4000)
    parents.means.zero_()
    parents.log_scales[:, 0] = math.log(3.0)
    turn = math.pi / 8  # half the angle about z
    parents.quats_wxyz[:] = torch.tensor([math.cos(turn), 0.0, 0.0, math.sin(turn)])
    spread = torch.cov(split(parents, generator(1)).means.T)
    expected = torch.tensor([[5.0, 4.0, 0.0], [4.0, 5.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(spread, expected, rtol=0, atol=0.3)


def test_the_longest_axis_tells_what_is_large_beside_the_scene():
    for unit in (1.0, 100.0):
        gaussians = map_of([0.01 * unit] * 2)
        gaussians.log_scales[1, 0] = math.log(unit)
        optimizer = MapOptimizer(gaussians, LearningRates())
        densify(optimizer, over_three_views(torch.ones(2)), unit, CONFIG, generator(0))
        assert optimizer.gaussians.anchor_keyframe.tolist() == [0, 0, 1, 1]
        small = torch.full((2, 3), 0.01 * unit)  # a clone, hence of the same size
        torch.testing.assert_close(optimizer.gaussians.scales[:2], small)


def test_a_long_needle_is_huge():
    gaussians = map_of([0.01, 0.01])
    gaussians.log_scales[1, 0] = 5  # 148 world units
    assert useful_rows(gaussians, HERE, 1.0).tolist() == [True, False]
