"""The features of DINOv2 and FiT3D against the official code."""

from functools import cache

import pytest
import torch

from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.vit import DinoFeatures, is_antialiased
from tests.helpers import frame_of
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

TOLERANCE = 2e-5  # the official code differs from its own float64 run by 3e-6
NETWORKS = {
    "dinov2_vits14": False,
    "dinov2_vits14_reg": True,
    "fit3d_reg_small": True,
}


@cache
def weights(name: str) -> Weights:
    return rebuilt.weights_of(name)


# Known answers


@pytest.mark.parametrize("name", NETWORKS)
def test_the_features_of_an_image_are_those_of_the_official_path(name: str):
    extractor = DinoFeatures(weights(name))
    features = extractor(frame_of(rebuilt.image(100, 135)))
    assert features.shape == (100 // 14, 135 // 14, extractor.dimension)
    expected = rebuilt.golden(name)["wildgs_100x135/features_every2"]
    rebuilt.assert_close(features[..., ::2], expected, TOLERANCE)


def test_the_position_resize_follows_from_the_layout():
    for name, resize in NETWORKS.items():
        assert is_antialiased(weights(name)) is resize
    timm = Weights({n: torch.zeros(1) for n in rebuilt.shapes_of("fit3d_small")}, "f.pth")
    assert is_antialiased(timm) is True


# Identities


def test_features_can_be_trained_on_and_are_repeatable():
    extractor = DinoFeatures(weights("fit3d_reg_small"))
    features = extractor(frame_of(rebuilt.image(28, 42)))
    assert torch.equal(features, extractor(frame_of(rebuilt.image(28, 42))))
    weight = torch.ones(features.shape[-1], requires_grad=True)
    (features @ weight).sum().backward()  # an inference tensor would refuse
    assert torch.isfinite(weight.grad).all()
