"""Depth Anything V2 against the official code."""

from functools import cache

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.depth_anything import (
    DepthAnything,
    DepthAnythingConfig,
)
from minislam.priors.networks.vit import normalise
from minislam.records import Frame
from tests.priors.networks import rebuilt

RELATIVE, METRIC = 2e-5, 1e-4  # the official code differs from its own float64 run by 2e-5 m
INDOOR = 20.0  # metre, largest depth of the training


@cache
def weights() -> Weights:
    return rebuilt.weights_of("depth_anything_v2_vits")


def prior_of(shorter_side: int, limit: float = INDOOR) -> DepthAnything:
    return DepthAnything(weights(), DepthAnythingConfig(shorter_side, limit))


@cache
def raw_output(height: int, width: int) -> torch.Tensor:
    with torch.inference_mode():
        return prior_of(28).network(normalise(rebuilt.image(height, width)))[0]


def frame(image: torch.Tensor) -> tuple[Frame, Camera]:
    height, width = image.shape[:2]
    return Frame(0, 0.0, image), Camera(50, 50, width / 2, height / 2, width, height)


# Known answers


@pytest.mark.parametrize("size", [(56, 84), (112, 70)])
def test_metric_depth_is_that_of_the_official_code(size: tuple[int, int]):
    expected = rebuilt.golden("depth_anything_v2_vits")[f"metric/{size[0]}x{size[1]}/depth"]
    rebuilt.assert_close(INDOOR * raw_output(*size).sigmoid(), expected, METRIC)


def test_relative_disparity_is_that_of_the_official_code():
    expected = rebuilt.golden("depth_anything_v2_vits")["relative/56x84/depth"]
    rebuilt.assert_close(raw_output(56, 84).relu(), expected, RELATIVE)


def test_the_depth_of_an_image_is_that_of_the_official_path():
    # The official function takes 8-bit BGR: what was stored saw channels 0 and 2 swapped.
    as_bytes = (255 * rebuilt.image(48, 64)).to(torch.uint8)
    depth = prior_of(70)(*frame(as_bytes.flip(-1).float() / 255))
    expected = rebuilt.golden("depth_anything_v2_vits")["metric/infer_image_48x64_in70/depth"]
    rebuilt.assert_close(depth, expected, METRIC)


# Identities


def test_the_depth_scales_with_the_limit_of_the_training():
    image = rebuilt.image(30, 40)
    indoor, outdoor = (prior_of(28, limit)(*frame(image)) for limit in (20.0, 80.0))
    torch.testing.assert_close(outdoor, 4 * indoor)


def test_the_limit_follows_from_the_official_name():
    for name, limit in (("a/depth_anything_v2_metric_hypersim_vits", 20), ("metric_vkitti", 80)):
        named = Weights(weights().as_dict(), f"{name}.pth")
        assert DepthAnything(named, DepthAnythingConfig()).depth_limit == limit


# Errors


def test_a_relative_checkpoint_is_refused_by_its_name():
    with pytest.raises(InputError, match=r"found depth_anything_v2_vits\.pth, whose output may"):
        prior_of(518, 0.0)
