"""The vision transformer against the official code, at every layout and position resize."""

from functools import cache

import pytest
import torch

from minislam.errors import InputError
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.vit import Tokens, VisionTransformer, normalise
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

TOLERANCE = 2e-5  # the official code differs from its own float64 run by 3e-6
NETWORKS = {  # name: (position resize, names of the stored outputs)
    "dinov2_vits14": (False, "x_norm_patchtokens"),
    "dinov2_vits14_reg": (True, "x_norm_patchtokens"),
    "fit3d_reg_small": (True, "norm_patch"),
}


@cache
def weights(name: str) -> Weights:
    return rebuilt.weights_of(name)


@cache
def tokens(name: str, height: int, width: int) -> Tokens:
    transformer = VisionTransformer(weights(name), NETWORKS[name][0])
    with torch.inference_mode():
        return transformer(normalise(rebuilt.image(height, width)))[0]


# Known answers


@pytest.mark.parametrize("name", NETWORKS)
def test_patch_tokens_are_those_of_the_official_code(name: str):
    stored = rebuilt.golden(name)
    for size in [(56, 84), (112, 70)]:
        expected = stored.get(f"{size[0]}x{size[1]}/{NETWORKS[name][1]}")
        if expected is not None:
            patches = tokens(name, *size).patches[0].flatten(1).T
            rebuilt.assert_close(patches, expected, TOLERANCE)


def test_leading_tokens_are_those_of_the_official_code():
    plain, registers = rebuilt.golden("dinov2_vits14"), rebuilt.golden("dinov2_vits14_reg")
    leading = tokens("dinov2_vits14", 56, 84).leading[0]
    rebuilt.assert_close(leading, plain["56x84/x_norm_clstoken"][None], TOLERANCE)
    leading = tokens("dinov2_vits14_reg", 56, 84).leading[0]
    rebuilt.assert_close(leading[0], registers["56x84/x_norm_clstoken"], TOLERANCE)
    rebuilt.assert_close(leading[1:], registers["56x84/x_norm_regtokens"], TOLERANCE)
    expected = rebuilt.golden("fit3d_reg_small")["56x84/norm_prefix"]
    rebuilt.assert_close(tokens("fit3d_reg_small", 56, 84).leading[0], expected, TOLERANCE)


def test_the_trained_size_needs_no_resize_of_the_positions():
    expected = rebuilt.golden("dinov2_vits14")["518x518/x_norm_patchtokens_every37"]
    patches = tokens("dinov2_vits14", 518, 518).patches[0].flatten(1).T
    rebuilt.assert_close(patches[::37], expected, TOLERANCE)


def test_the_other_position_resize_would_be_noticed():
    transformer = VisionTransformer(weights("dinov2_vits14"), True)
    patches = transformer(normalise(rebuilt.image(56, 84)))[0].patches[0].flatten(1).T
    expected = rebuilt.golden("dinov2_vits14")["56x84/x_norm_patchtokens"]
    assert (patches - expected).abs().max() > 0.1


# Errors


def test_a_giant_is_refused_in_words():
    tensors = {"patch_embed.proj.weight": torch.zeros(1536, 1, 1, 1)}
    with pytest.raises(InputError, match=r"384, 768, 1024 \(S, B, L\) in g\.pth, .* width 1536"):
        VisionTransformer(Weights(tensors, "g.pth"), False)
