"""Classical features: similar on one surface, different on two, always finite."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.priors.features import ClassicalFeatures, HighResolutionFeatures, oriented_edges
from tests.helpers import frame_of, generator


def textured(seed: int, rgb: tuple[float, float, float], height: int = 240, width: int = 320):
    """Return a surface (H, W, 3) of one colour with blurred noise on it."""
    noise = np.random.default_rng(seed).standard_normal((height, width)).astype(np.float32)
    noise = 0.5 * cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(np.array(rgb, np.float32) * (1 + noise[..., None]), 0, 1)


def cosine(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.cosine_similarity(a, b, dim=-1)


# Known answers


def test_shape_is_one_vector_per_full_cell_and_length_is_sqrt_of_the_dimension():
    extractor = ClassicalFeatures()
    features = extractor(frame_of(torch.from_numpy(textured(0, (0.6, 0.3, 0.2), 250, 333))))
    assert features.shape == (250 // 7, 333 // 7, extractor.dimension)
    assert features.dtype == torch.float32
    expected = torch.full(features.shape[:2], extractor.dimension**0.5)
    torch.testing.assert_close(features.norm(dim=-1), expected)


def test_a_vertical_ramp_falls_into_the_bin_of_ninety_degrees():
    # Brightness grows by 2 per row, so the gradient is (0, 2): bin 90 / 180 * 8 = 4.
    ramp = np.repeat(2.0 * np.arange(20, dtype=np.float32)[:, None], 20, 1)
    edges = np.stack(oriented_edges(ramp), -1)[5:-5, 5:-5]
    expected = np.zeros(8, np.float32)
    expected[4] = 2
    np.testing.assert_allclose(edges, np.broadcast_to(expected, edges.shape), atol=1e-3)


def test_opposite_gradients_share_a_bin_and_bins_sum_to_the_magnitude():
    image = textured(1, (0.5, 0.5, 0.5))[..., 0] * 100
    edges = oriented_edges(image)
    # cv2 computes angles to about 0.01 degree, hence the tolerance.
    np.testing.assert_allclose(edges, oriented_edges(-image), atol=0.02)
    du = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    np.testing.assert_allclose(sum(edges), np.hypot(du, dv), rtol=1e-4, atol=1e-4)


# What the features are for


def test_the_same_surface_from_two_views_is_similar_and_two_surfaces_are_not():
    wall = textured(0, (0.75, 0.70, 0.60))
    person = textured(1, (0.15, 0.25, 0.55))
    moved = cv2.warpAffine(
        wall, np.array([[1.1, 0.1, -23.0], [-0.1, 1.1, 9.0]]), (320, 240), borderMode=4
    )
    extractor = ClassicalFeatures()
    first, second, other = (
        extractor(frame_of(torch.from_numpy(im))) for im in (wall, moved, person)
    )
    assert cosine(first, second).median() > 0.9
    assert cosine(first, other).median() < 0.3


def test_an_object_in_the_image_is_separated_from_its_background():
    image = textured(0, (0.7, 0.65, 0.5))
    image[84:168, 112:224] = textured(1, (0.6, 0.15, 0.15))[84:168, 112:224]
    features = ClassicalFeatures()(frame_of(torch.from_numpy(image)))
    inside = features[7:11, 9:15].reshape(-1, features.shape[-1])
    outside = features[13:, :].reshape(-1, features.shape[-1])
    within = cosine(inside[:, None], inside[None]).mean()
    across = cosine(inside[:, None], outside[None]).mean()
    assert within > 0.75 > across, (within, across)


# Identities


def test_the_same_image_gives_the_same_bytes():
    frame = frame_of(torch.from_numpy(textured(3, (0.4, 0.5, 0.3))))
    assert torch.equal(ClassicalFeatures()(frame), ClassicalFeatures()(frame))


# Degenerate input


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images_give_finite_features_of_full_length(value: float):
    extractor = ClassicalFeatures()
    features = extractor(frame_of(torch.full((56, 70, 3), value)))
    assert torch.isfinite(features).all()
    assert features.norm(dim=-1).min() > 0.99 * extractor.dimension**0.5


def test_a_single_cell_works():
    one_cell = frame_of(torch.rand(7, 7, 3, generator=generator(0)))
    assert ClassicalFeatures()(one_cell).shape[:2] == (1, 1)


def test_features_that_are_not_finite_are_refused_with_the_number_of_the_frame():
    class Spoilt(ClassicalFeatures):
        def __call__(self, frame):
            features = super().__call__(frame)
            features[0, 0, 0] = float("nan") if frame.frame_index == 7 else 1.0
            return features

    features = HighResolutionFeatures(Spoilt(), 1)
    image = torch.rand(30, 40, 3, generator=generator(0))
    good, spoilt = (replace(frame_of(image), frame_index=number) for number in (6, 7))
    assert torch.equal(features(good), Spoilt()(good))
    with pytest.raises(InputError, match="finite features of frame 7, found NaN or infinity; give"):
        features(spoilt)
