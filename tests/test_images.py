"""Gaussian windows and local moments, against scipy and plain formulas."""

import pytest
import torch
from scipy import ndimage
from torch.nn import functional

from minislam.images import SSIM_SIGMA, gaussian_blur, local_moments, resample, shrink_image
from tests.helpers import generator


def random_images(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


# Known answers


@pytest.mark.parametrize(("height", "width"), [(37, 70), (5, 3), (1, 1)])
def test_blur_agrees_with_scipy(height: int, width: int):
    image = random_images(0, height, width)  # 70 px are three strips; 3 px are less than a window
    expected = ndimage.gaussian_filter(image.numpy(), 1.5, mode="constant", radius=3)
    torch.testing.assert_close(gaussian_blur(image, 7, 1.5), torch.from_numpy(expected))


def test_a_single_pixel_becomes_the_window():
    image = torch.zeros(9, 9, dtype=torch.float64)
    image[4, 4] = 1
    blurred = gaussian_blur(image, 3, 1.0)
    side = 0.6065306597126334  # exp(-1/2)
    centre = 1 / (1 + 2 * side)
    assert float(blurred[4, 4]) == pytest.approx(centre**2)
    assert float(blurred[4, 5]) == pytest.approx(side * centre**2)
    assert float(blurred.sum()) == pytest.approx(1)
    assert blurred[4, 6] == 0  # the window has 3 px


# Identities


@pytest.mark.parametrize("size", [(12, 20), (4, 10), (9, 7), (24, 20)])
def test_a_smaller_image_holds_the_means_of_the_areas(size: tuple[int, int]):
    image = random_images(3, 24, 20, 3)
    expected = functional.adaptive_avg_pool2d(image.permute(2, 0, 1)[None], size)[0]
    torch.testing.assert_close(shrink_image(image, *size), expected.permute(1, 2, 0))


def test_moments_are_the_blurred_powers():
    x, y = random_images(1, 3, 20, 24), random_images(2, 3, 20, 24)
    moments = local_moments(x, y, 11)
    for found, powers in zip(moments, (x, x * x, x * y, y, y * y), strict=True):
        torch.testing.assert_close(found, gaussian_blur(powers, 11, SSIM_SIGMA))


def test_blur_is_its_own_transpose():
    # The backward of the SSIM loss relies on it: <B x, y> = <x, B y>.
    x, y = random_images(3, 37, 70), random_images(4, 37, 70)
    forward, backward = (gaussian_blur(x, 11, 1.5) * y).sum(), (x * gaussian_blur(y, 11, 1.5)).sum()
    torch.testing.assert_close(forward, backward)


def test_resampling_keeps_a_constant_and_hits_cell_centres():
    ramp = torch.arange(24.0)[None].expand(20, 24)
    # 4 cells over 24 px: centres at (j + 0.5) * 6 - 0.5.
    torch.testing.assert_close(resample(ramp, 5, 4)[2], torch.tensor([2.5, 8.5, 14.5, 20.5]))


def test_upsampling_puts_cell_centres_where_the_convention_says():
    # 4 cells over 32 px: centres at (j + 0.5) * 8 - 0.5 = 3.5, 11.5, ...; a ramp stays a ramp.
    ramp = torch.arange(4.0)[None].expand(3, 4)
    image = resample(ramp, 24, 32)
    u = torch.arange(32.0)
    inside = (u >= 3.5) & (u <= 27.5)
    torch.testing.assert_close(image[10][inside], ((u - 3.5) / 8)[inside])
