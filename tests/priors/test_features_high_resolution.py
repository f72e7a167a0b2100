"""Features between the patches, from shifted images."""

import pytest
import torch
from torch.nn import functional

from minislam.priors.features import ClassicalFeatures, HighResolutionFeatures, shift_image
from minislam.records import Frame
from tests.helpers import generator

PATCH = 8  # px


class PatchMean:
    """The mean colour of each patch: a feature whose finer version is known."""

    stride, dimension = PATCH, 3

    def __call__(self, frame: Frame) -> torch.Tensor:
        mean = functional.avg_pool2d(frame.image.permute(2, 0, 1), PATCH)
        return mean.permute(1, 2, 0)


def frame(image: torch.Tensor) -> Frame:
    return Frame(0, 0.0, image)


def ramp(height: int = 24, width: int = 40) -> torch.Tensor:
    u, v = torch.meshgrid(torch.arange(float(width)), torch.arange(float(height)), indexing="xy")
    return torch.stack([u / width, v / height, torch.full_like(u, 0.5)], -1)


# Known answers


@pytest.mark.parametrize("factor", [2, 4])
def test_means_of_a_ramp_are_those_at_the_centres_of_the_finer_cells(factor: int):
    features = HighResolutionFeatures(PatchMean(), factor)(frame(ramp()))
    assert features.shape == (3 * factor, 5 * factor, 3)
    column = (torch.arange(5 * factor) + 0.5) * PATCH / factor - 0.5
    inner = slice(factor, -factor)  # beyond the border the ramp goes on level
    expected = (column / 40)[inner]
    torch.testing.assert_close(features[factor, inner, 0], expected, rtol=0, atol=1e-5)
    row = (torch.arange(3 * factor) + 0.5) * PATCH / factor - 0.5
    torch.testing.assert_close(features[inner, factor, 1], (row / 24)[inner], rtol=0, atol=1e-5)


def test_an_image_is_shifted_by_whole_and_by_half_pixels():
    image = ramp()
    torch.testing.assert_close(shift_image(image, 3, 1)[:-1, :-3], image[1:, 3:])
    half = shift_image(image, 0.5, 0)[:, :-1]
    torch.testing.assert_close(half, (image[:, 1:] + image[:, :-1]) / 2)
    torch.testing.assert_close(shift_image(image, 0, 0), image)


# Identities


def test_an_odd_factor_keeps_the_coarse_features_among_the_fine_ones():
    image = torch.rand(35, 42, 3, generator=generator(1))
    extractor = ClassicalFeatures()
    fine = HighResolutionFeatures(extractor, 3)(frame(image))
    torch.testing.assert_close(fine[1::3, 1::3], extractor(frame(image)), rtol=0, atol=1e-3)


def test_the_finer_stride_is_that_of_the_parts_of_a_patch():
    strides = [HighResolutionFeatures(PatchMean(), factor).stride for factor in (1, 2, 3, 99)]
    assert strides == [8, 4, 3, 1]
