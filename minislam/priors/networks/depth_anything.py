"""Depth Anything V2 with its metric heads (paper, ablation of the depth prior).

The tokens of a ViT are read after four of its blocks. Each reading becomes a map of its own
resolution, and the maps are fused from coarse to fine (a "dense prediction transformer"). The
network does not know the focal length: it assumes the camera of its training.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.parameters import parameter
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame

SHORTER_SIDE = 518  # px the network sees, as in its training
INDOOR_LIMIT, OUTDOOR_LIMIT = 20.0, 80.0  # metre; the Hypersim and the Virtual KITTI checkpoints
_LIMIT_OF_NAME = {"metric_hypersim": INDOOR_LIMIT, "metric_vkitti": OUTDOOR_LIMIT}
_TAPS = {12: (2, 5, 8, 11), 24: (4, 11, 17, 23)}  # by the number of blocks: S and B, L


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Size of the input, and scale of the output."""

    shorter_side: int = parameter(SHORTER_SIDE, "shorter side of what it sees [px], official", 1)
    depth_limit: float = parameter(
        0.0, "largest depth of the training [m]; 0: as the official file name says (20 or 80)"
    )


class DepthAnythingHead:
    """The convolutions behind the transformer: tokens in, one number per pixel out."""

    def __init__(self, weights: Weights) -> None:
        transformer = VisionTransformer(weights.below("pretrained."))
        self.transformer, self.weights = transformer, weights.below("depth_head.")
        self.taps = _TAPS[transformer.depth]

    def __call__(
        self,
        image: Tensor,  # (B, 3, H, W) normalised, H and W multiples of 14
    ) -> Tensor:  # (B, H, W), before the last activation
        """Return the raw output: its sigmoid is metric depth, its ReLU relative disparity."""
        weights = self.weights
        readings = self.transformer(image, self.taps)
        maps = [weights.conv(f"projects.{k}", tokens.patches) for k, tokens in enumerate(readings)]
        # Resolutions of 4, 2, 1 and 1/2 cells per patch side.
        maps[0] = weights.upconv("resize_layers.0", maps[0])
        maps[1] = weights.upconv("resize_layers.1", maps[1])
        maps[3] = weights.conv("resize_layers.3", maps[3], stride=2)
        scratch = weights.below("scratch.")
        maps = [scratch.conv(f"layer{k + 1}_rn", m, bias=False) for k, m in enumerate(maps)]

        fused = _fuse(scratch.below("refinenet4."), maps[3], None, maps[2].shape[-2:])
        fused = _fuse(scratch.below("refinenet3."), fused, maps[2], maps[1].shape[-2:])
        fused = _fuse(scratch.below("refinenet2."), fused, maps[1], maps[0].shape[-2:])
        rows, cols = maps[0].shape[-2:]
        fused = _fuse(scratch.below("refinenet1."), fused, maps[0], (2 * rows, 2 * cols))

        out = _resize(scratch.conv("output_conv1", fused), image.shape[-2:])
        out = functional.relu(scratch.conv("output_conv2.0", out))
        return scratch.conv("output_conv2.2", out, channels=(1,))[:, 0]


def _fuse(weights: Weights, coarse: Tensor, fine: Tensor | None, size: tuple[int, ...]) -> Tensor:
    """Add a finer map to a coarser one and bring the sum to a size."""
    if fine is not None:
        coarse = coarse + _residual_unit(weights.below("resConfUnit1."), fine)
    fused = _resize(_residual_unit(weights.below("resConfUnit2."), coarse), size)
    return weights.conv("out_conv", fused)


def _residual_unit(weights: Weights, x: Tensor) -> Tensor:
    hidden = weights.conv("conv1", functional.relu(x))
    return x + weights.conv("conv2", functional.relu(hidden))


def _resize(x: Tensor, size: tuple[int, ...]) -> Tensor:
    return functional.interpolate(x, size, mode="bilinear", align_corners=True)


class DepthAnything:
    """Metric depth by Depth Anything V2: a `DepthPrior`."""

    def __init__(
        self,
        weights: Weights,
        depth_limit: float,  # metre, of the training data: INDOOR_LIMIT or OUTDOOR_LIMIT
        shorter_side: int = SHORTER_SIDE,
    ) -> None:
        self.depth_limit = depth_limit
        self.shorter_side = shorter_side
        self.device = weights.device
        self.network = DepthAnythingHead(weights)

    def __call__(self, frame: Frame, camera: Camera) -> Tensor:
        """Return the depth (H, W) in metres that the network sees in an image."""
        size = tuple(frame.image.shape[:2])
        with torch.no_grad():
            seen = normalise(self._resized(frame.image), self.device)
            depth = self.depth_limit * torch.sigmoid(self.network(seen))
            full = _resize(depth[None], size)[0, 0]
        return full.to(frame.image.device)

    def _resized(self, image: Tensor) -> Tensor:
        """Return the image with sides of whole patches, the shorter one of `shorter_side`."""
        height, width = image.shape[:2]
        scale = max(self.shorter_side / height, self.shorter_side / width)
        rows, cols = (_whole_patches(side * scale, self.shorter_side) for side in (height, width))
        # In float64, as the official code: float32 weights of the cubic differ in the last digits.
        resized = cv2.resize(
            image.double().cpu().numpy(), (cols, rows), interpolation=cv2.INTER_CUBIC
        )
        return torch.from_numpy(resized).float()


def _whole_patches(side: float, shortest: int) -> int:
    rounded = round(side / PATCH) * PATCH
    return rounded if rounded >= shortest else math.ceil(side / PATCH) * PATCH


def build_depth_anything(weights: Weights, config: DepthAnythingConfig) -> DepthAnything:
    """Return the prior after one run on a tiny image, which asks for every tensor it needs."""
    limit = config.depth_limit or limit_of_name(Path(weights.file))
    prior = DepthAnything(weights, limit, config.shorter_side)
    prior.network(torch.zeros(1, 3, 2 * PATCH, 2 * PATCH, device=weights.device))
    return prior


def limit_of_name(path: Path) -> float:
    """Return the largest depth [m] that a checkpoint was trained with, from its official name.

    The file itself states neither this depth nor whether its output is metric.
    """
    for part, limit in _LIMIT_OF_NAME.items():
        if part in path.name:
            return limit
    raise InputError(
        f"expected {' or '.join(_LIMIT_OF_NAME)} in the name of a Depth Anything checkpoint, found "
        f"{path.name}, whose output may be no metric depth; keep the official name of the file"
    )
