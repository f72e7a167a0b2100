"""Metric3D v2 against the official code, and its handling of the camera."""

from functools import cache

import pytest
import torch
from torch.nn import functional

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.metric3d import Metric3DDepth, fit
from minislam.priors.networks.vit import normalise
from minislam.records import Frame
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

# With one or two threads the official code differs from itself by 1e-4 m and 4e-6.
DEPTH, REST = 1e-3, 5e-5
SMALL_SIZE = (56, 84)


@cache
def weights() -> Weights:
    return rebuilt.weights_of("metric3d_vit_small")


@cache
def output(height: int, width: int) -> torch.Tensor:
    with torch.inference_mode():
        return Metric3DDepth(weights()).network(normalise(rebuilt.image(height, width)))


def stored(name: str) -> torch.Tensor:
    return rebuilt.golden("metric3d_vit_small")[name]


# Known answers


@pytest.mark.parametrize("size", [(56, 84), (112, 56)])
def test_the_depth_is_that_of_the_official_code(size: tuple[int, int]):
    rebuilt.assert_close(output(*size)[0], stored(f"{size[0]}x{size[1]}/depth"), DEPTH)


def test_the_finest_map_is_that_of_the_official_code():
    with torch.inference_mode():
        fine, *_ = Metric3DDepth(weights()).maps(normalise(rebuilt.image(56, 84)))
    rebuilt.assert_close(fine[0, ::16], stored("56x84/read_0_every16ch"), REST)


def test_the_whole_box_is_that_of_the_official_slam():
    # The official system resizes the depth bicubically and scales by the focal length of the
    # image before any resizing, here 87.5 px.
    canonical, _ = Metric3DDepth(weights()).canonical_depth(rebuilt.image(60, 96))
    full = functional.interpolate(canonical[None, None], (60, 96), mode="bicubic")[0, 0]
    rebuilt.assert_close(full * 87.5 / 1000, stored("wildgs_60x96_fx87.5/depth"), DEPTH)


# Identities


def frame(image: torch.Tensor) -> Frame:
    return Frame(0, 0.0, image)


def test_depth_is_scaled_by_the_focal_length_of_the_image_the_network_saw():
    image = rebuilt.image(28, 42)
    prior = Metric3DDepth(weights(), SMALL_SIZE)
    near = prior(frame(image), Camera(30, 30, 20.5, 13.5, 42, 28))
    far = prior(frame(image), Camera(60, 60, 20.5, 13.5, 42, 28))
    torch.testing.assert_close(far, 2 * near)
    canonical, scale = prior.canonical_depth(image)
    assert scale == 2 and canonical.shape == SMALL_SIZE
    full = functional.interpolate(canonical[None, None], (28, 42), mode="bilinear")[0, 0]
    torch.testing.assert_close(near, full * 30 * 2 / 1000)


@pytest.mark.parametrize("size", [(240, 320), (320, 240), (289, 300), (17, 400), (720, 1280)])
def test_an_image_is_fitted_without_changing_its_aspect(size: tuple[int, int]):
    image, inside, scale = fit(torch.ones(*size, 3), (616, 1064))
    assert image.shape == (1, 3, 616, 1064)
    inner = image[0, :, *inside]
    assert inner.shape[1] == 616 or inner.shape[2] == 1064
    assert (inner > 1).all()  # white, normalised
    assert abs(inner.shape[1] - size[0] * scale) < 1
    assert abs(inner.shape[2] - size[1] * scale) < 1
    outside = image.sum() - inner.sum()
    assert abs(float(outside)) < 1e-2 * float(inner.sum())  # only the mean colour around it


# Errors


def test_an_odd_size_is_refused():
    with pytest.raises(InputError, match=r"multiples of 28 px, found \(616, 1066\)"):
        Metric3DDepth(weights(), (616, 1066))
