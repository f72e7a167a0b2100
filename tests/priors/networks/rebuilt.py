"""Weights and images made by a rule, for networks whose official output is stored.

The stored outputs were computed by the official code with every parameter filled by this rule
(integer hashes, so the same on every machine). A network that agrees with them is the official
one, and no checkpoint has to be at hand.
"""

import json
import zlib
from pathlib import Path

import numpy as np
import torch

from minislam.priors.networks.checkpoints import Weights

DATA = Path(__file__).parent.parent.parent / "data" / "networks"


def noise(name: str, count: int) -> np.ndarray:
    """Return `count` numbers in [-1, 1): the top 24 bits of splitmix64 of a counter."""
    with np.errstate(over="ignore"):
        x = (np.uint64(zlib.crc32(name.encode())) << np.uint64(32)) + np.arange(
            count, dtype=np.uint64
        )
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x = x ^ (x >> np.uint64(31))
    return (x >> np.uint64(40)).astype(np.float64) / 2.0**23 - 1.0


def parameter_values(name: str, shape: list[int]) -> np.ndarray:
    """Return the values of one parameter, a function of its name and shape."""
    # Metric3D stores one layer norm under two names.
    r = noise(name.replace(".norm3.", ".downsample.1."), int(np.prod(shape))).reshape(shape)
    kind = name.rsplit(".", 1)[-1]
    if kind == "gamma":
        values = 0.5 + 0.25 * r
    elif kind == "bias":
        values = 0.1 * r
    elif kind == "weight":
        values = 1.0 + 0.1 * r if len(shape) == 1 else r * np.sqrt(3.0 / np.prod(shape[1:]))
    else:
        values = 0.5 * r
    if ".flow_head.conv2" in name:  # keeps Metric3D's depth away from its limits
        values = 0.05 * values
    return values.astype(np.float32)


def shapes_of(network: str) -> dict[str, list[int]]:
    return json.loads((DATA / f"{network}_keys.json").read_text())


def tensors_of(shapes: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    return {n: torch.from_numpy(parameter_values(n, s)) for n, s in shapes.items()}


def weights_of(network: str) -> Weights:
    return Weights(tensors_of(shapes_of(network)), f"{network}.pth")


def golden(network: str) -> dict[str, torch.Tensor]:
    with np.load(DATA / f"{network}.npz") as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files}


def image(height: int, width: int) -> torch.Tensor:
    """Return an RGB image (H, W, 3) in [0, 1): half noise, half ramps that catch any flip."""
    u = 0.5 + 0.5 * noise(f"image/{height}x{width}", 3 * height * width)
    y, x = np.meshgrid(np.arange(height) / height, np.arange(width) / width, indexing="ij")
    ramps = np.stack([x, y, 1.0 - 0.5 * (x + y)])
    planes = (0.5 * u.reshape(3, height, width) + 0.5 * ramps).astype(np.float32)
    return torch.from_numpy(planes).permute(1, 2, 0)


def assert_close(actual: torch.Tensor, expected: torch.Tensor, absolute: float) -> None:
    assert actual.shape == expected.shape, (actual.shape, expected.shape)
    error = float((actual - expected).abs().max())
    assert error <= absolute, f"largest error {error:.2e} > {absolute:.0e}"
