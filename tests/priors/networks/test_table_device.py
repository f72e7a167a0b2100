"""Networks run where their weights are: nothing inside is created on another device.

The "meta" device computes shapes only, and refuses to meet tensors of the CPU: what passes here
also runs on a GPU, which no test needs.
"""

import pytest
import torch

from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.depth_anything import DepthAnything, DepthAnythingConfig
from minislam.priors.networks.droid import DroidFlow
from minislam.priors.networks.droid_network import cell_grid
from minislam.priors.networks.metric3d import Metric3DDepth, fit
from minislam.priors.networks.vit import VisionTransformer, is_antialiased, normalise
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

META = torch.device("meta")
IMAGE = torch.zeros(56, 84, 3, device=META)


def meta_weights(network: str) -> Weights:
    shapes = rebuilt.shapes_of(network)
    return Weights({n: torch.empty(s, device=META) for n, s in shapes.items()}, f"{network}.pth")


def test_vision_transformers():
    for network in ("dinov2_vits14", "dinov2_vits14_reg", "fit3d_small", "fit3d_reg_small"):
        weights = meta_weights(network)
        transformer = VisionTransformer(weights, is_antialiased(weights))
        tokens = transformer(normalise(IMAGE))[0]
        assert tokens.patches.shape == (1, 384, 4, 6) and tokens.patches.device == META


def test_depth_networks_of_both_sizes():
    for network in ("depth_anything_v2_vits", "depth_anything_v2_vitl"):
        prior = DepthAnything(meta_weights(network), DepthAnythingConfig(depth_limit=20.0))
        assert prior.network(normalise(IMAGE)).shape == (1, 56, 84)
    for network in ("metric3d_vit_small", "metric3d_vit_large"):
        prior = Metric3DDepth(meta_weights(network), (112, 168))
        found = prior.network(fit(IMAGE, prior.network_size)[0])
        assert found.shape == (1, 112, 168) and found.device == META


def test_droid():
    flow = DroidFlow(meta_weights("droid"))
    frame = flow.encode(torch.zeros(64, 72, 3))
    where = cell_grid(torch.empty(1, 8, 9, 2, device=META))[None]
    both = frame.features, frame.features
    hidden, target, confidence = flow.update(*both, *frame.context, where, where)
    assert flow.damping(hidden).device == META
    assert hidden.shape == (1, 128, 8, 9) and hidden.device == META
    assert target.shape == confidence.shape == (1, 8, 9, 2)
