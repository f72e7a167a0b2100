"""DROID-SLAM's network against the official code (run in float64, stored as float32)."""

import json
from functools import cache

import numpy as np
import pytest
import torch

from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.droid_network import (
    cell_grid,
    correlation_pyramid,
    damping,
    encode_context,
    encode_features,
    look_up,
    update,
)
from minislam.priors.networks.vit import normalise
from tests.helpers import generator
from tests.priors.networks import rebuilt

TOLERANCE = 1e-3  # standard deviations; typical mistakes cost 0.2 to 0.6
SOURCES, TARGETS = [0, 1, 0, 2], [1, 0, 2, 1]
ARRAYS = json.loads((rebuilt.DATA / "droid_arrays.json").read_text())


@cache
def weights() -> Weights:
    return rebuilt.weights_of("droid")


@cache
def stored() -> dict[str, torch.Tensor]:
    return rebuilt.golden("droid")


def moving_image(frame: int, height: int = 128, width: int = 160) -> torch.Tensor:
    """Return an RGB image (H, W, 3) of a smooth pattern that moves by (-3, 1.5) px per frame."""
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    x, y = x + 3.0 * frame, y - 1.5 * frame
    channels = [
        127.5
        + 50 * np.sin(0.31 * x + 0.17 * y + 1.1 * c)
        + 40 * np.cos(0.13 * x - 0.29 * y + 0.7 * c)
        + 30 * np.sin(0.9 * x) * np.cos(0.8 * y + 0.5 * c)
        for c in range(3)
    ]
    rounded = np.floor(np.clip(np.stack(channels, -1), 0, 255) + 0.5)
    return torch.from_numpy((rounded / 255).astype(np.float32))


def assert_golden(actual: torch.Tensor, name: str) -> None:
    """Compare with a stored array, of which only every so manieth value may be kept."""
    array = ARRAYS[name]
    assert list(actual.shape) == array["shape"], (name, actual.shape)
    difference = (actual.reshape(-1)[:: array["stride"]] - stored()[name].reshape(-1)).abs().max()
    assert difference <= TOLERANCE * array["std"], f"{name}: {float(difference / array['std']):.1e}"


@cache
@torch.inference_mode()
def encoded() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return features, first hidden state and context of three images."""
    images = torch.cat([normalise(moving_image(f)) for f in range(3)])
    return encode_features(weights(), images), *encode_context(weights(), images)


@cache
@torch.inference_mode()
def updated(iteration: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return hidden state, revision and confidence of the stored protocol.

    Each iteration starts from the official state.
    """
    features, first_hidden, context = encoded()
    expected = stored()[f"coords_it{iteration}"]
    if iteration == 1:
        hidden = first_hidden[SOURCES]
        last_target = expected + torch.tensor([0.25, -0.5])
    else:
        hidden = updated(1)[0]
        last_target = stored()["coords_it1"] + stored()["delta_it1"]
    both = features[SOURCES], features[TARGETS]
    if iteration == 1:
        assert_golden(look_up(correlation_pyramid(*both), expected), "corr_it1")
    hidden, target, confidence = update(
        weights(), *both, hidden, context[SOURCES], expected, last_target
    )
    return hidden, target - expected, confidence


# Known answers


def test_encoders_are_those_of_the_official_code():
    for part, name in zip(encoded(), ("fmap", "net0", "inp"), strict=True):
        assert_golden(part, name)


@pytest.mark.parametrize("iteration", [1, 2])
def test_updates_are_those_of_the_official_code(iteration: int):
    for part, name in zip(updated(iteration), ("net", "delta", "weight"), strict=True):
        assert_golden(part, f"{name}_it{iteration}")


@pytest.mark.parametrize("iteration", [1, 2])
@torch.inference_mode()
def test_damping_is_that_of_the_official_code(iteration: int):
    hidden = updated(iteration)[0]
    of_source = [hidden[[s == source for s in SOURCES]] for source in sorted(set(SOURCES))]
    found = torch.stack([damping(weights(), edges) for edges in of_source])
    assert_golden(found, f"eta_it{iteration}")


@torch.inference_mode()
def test_the_first_look_between_frames_is_that_of_the_official_code():
    features, hidden, seen = (part[:1] for part in encoded())
    still = cell_grid(torch.zeros(1, 16, 20, 2))[None]
    both = features, encoded()[0][1:2]
    _, target, confidence = update(weights(), *both, hidden, seen, still, still)
    assert_golden(target - still, "mf_delta")
    assert_golden(confidence, "mf_weight")


# Identities


def test_looking_up_whole_cells_reads_the_volume():
    features = torch.randn(2, 128, 8, 9, generator=generator(0))
    pyramid = correlation_pyramid(features[:1], features[1:])
    found = look_up(pyramid, cell_grid(torch.zeros(1, 8, 9, 2))[None])[0].reshape(4, 7, 7, 8, 9)
    expected = (features[0, :, 4, 5] * features[1, :, 3, 7]).sum() / 16
    # From cell (u, v) = (5, 4) two cells to the right and one up: offsets (2, -1), u first.
    torch.testing.assert_close(found[0, 3 + 2, 3 - 1, 4, 5], expected)
    assert found[0, 3 - 3, 3, 0, 0] == 0  # left of the image


def test_a_wider_head_of_a_checkpoint_is_cut():
    tensors = {name: weights()[name] for name in weights()}
    for head in ("update.delta.2", "update.weight.2"):
        for kind in ("weight", "bias"):
            name = f"{head}.{kind}"
            tensors[name] = torch.cat([tensors[name], tensors[name][:1]])
    maps, where = 4 * [torch.zeros(1, 128, 8, 9)], torch.zeros(1, 8, 9, 2)
    narrow = update(weights(), *maps, where, where)
    wide = update(Weights(tensors, "droid.pth"), *maps, where, where)
    assert all(torch.equal(a, b) for a, b in zip(narrow, wide, strict=True))


def test_edges_do_not_influence_each_other():
    features, hidden, seen = (part[[2]] for part in encoded())
    expected = stored()["coords_it1"][3:]
    last_target, both = expected + torch.tensor([0.25, -0.5]), (features, encoded()[0][[1]])
    _, alone, _ = update(weights(), *both, hidden, seen, expected, last_target)
    torch.testing.assert_close((alone - expected)[0], updated(1)[1][3], atol=1e-4, rtol=0)
