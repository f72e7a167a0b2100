"""PSNR and SSIM on constructed images."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.evaluation.images import psnr, ssim


def noise(seed: int, shape: tuple[int, ...] = (24, 20, 3)) -> np.ndarray:
    return np.random.default_rng(seed).random(shape)


# Known answers


def test_an_offset_of_a_tenth_is_twenty_decibel():
    assert psnr(np.full((4, 5, 3), 0.6), np.full((4, 5, 3), 0.5)) == pytest.approx(20, abs=1e-12)


def test_only_masked_pixels_count():
    image, mask = np.full((4, 4, 3), 0.5), np.zeros((4, 4), bool)
    other = image.copy()
    other[0, 0] += 0.01
    other[1:] += 0.3
    mask[0, 0] = True
    assert psnr(image, other, mask) == pytest.approx(40, abs=1e-9)


def test_ssim_of_two_constant_images():
    # Without structure only the luminance term is left: (2 a b + C1) / (a^2 + b^2 + C1).
    a, b, c1 = 0.2, 0.7, 1e-4
    found = ssim(np.full((16, 16), a), np.full((16, 16), b))
    assert found == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1), abs=1e-12)


def test_ssim_of_one_window_by_hand():
    # An 11x11 image has one window; its means are weighted sums over all pixels.
    x, y = noise(0, (11, 11)), noise(1, (11, 11))
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    mx, my = (weights * x).sum(), (weights * y).sum()
    vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
    cov = (weights * (x - mx) * (y - my)).sum()
    c1, c2 = 1e-4, 9e-4
    expected = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim(x, y) == pytest.approx(expected, abs=1e-12)


def test_overshooting_values_are_clipped():
    assert psnr(np.full((3, 3), 1.7), np.ones((3, 3))) == np.inf


# Identities


def test_equal_images_are_perfect_and_order_does_not_matter():
    x, y = noise(0), noise(1)
    assert psnr(x, x) == np.inf
    assert ssim(x, x) == pytest.approx(1, abs=1e-12)
    assert psnr(x, y) == psnr(y, x)
    assert ssim(x, y) == pytest.approx(ssim(y, x), abs=1e-12)
    assert abs(ssim(x, y)) < 0.2


def test_tensors_are_accepted():
    x, y = noise(0), noise(1)
    assert psnr(torch.from_numpy(x), torch.from_numpy(y)) == psnr(x, y)
    assert ssim(torch.from_numpy(x), torch.from_numpy(y)) == ssim(x, y)


# Errors


@pytest.mark.parametrize("measure", [psnr, ssim])
def test_integers_up_to_255_are_refused(measure: Callable[..., float]):
    grey, words = np.full((16, 16, 3), 100, np.uint8), r"of floats in \[0, 1\], found uint8; divide"
    for pair in ((grey, grey / 255), (grey / 255, torch.from_numpy(grey))):
        with pytest.raises(InputError, match=words):
            measure(*pair)


def test_other_sizes_empty_masks_and_tiny_images_are_refused():
    with pytest.raises(AssertionError):
        psnr(noise(0), noise(0)[:-1])
    with pytest.raises(AssertionError):
        psnr(noise(0), noise(1), np.zeros((24, 20), bool))
    with pytest.raises(AssertionError):
        psnr(noise(0), noise(1), np.ones((20, 24), bool))
    with pytest.raises(AssertionError):
        ssim(noise(0, (10, 30)), noise(1, (10, 30)))
