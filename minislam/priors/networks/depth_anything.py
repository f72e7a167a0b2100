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

from minislam.errors import require
from minislam.geometry import Camera
from minislam.parameters import parameter
from minislam.priors.networks.checkpoints import Weights, resize
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame

_LIMIT_OF_NAME = {"metric_hypersim": 20.0, "metric_vkitti": 80.0}  # metre; indoors and outdoors
_TAPS = {12: (2, 5, 8, 11), 24: (4, 11, 17, 23)}  # by the number of blocks: S and B, L


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Size of the input, and scale of the output."""

    shorter_side: int = parameter(518, "shorter side of what it sees [px], official", 1)
    depth_limit: float = parameter(
        0.0, "largest depth of the training [m]; 0: as the official file name says (20 or 80)"
    )


class DepthAnything:
    """Metric depth by Depth Anything V2: a `DepthPrior`."""

    def __init__(self, weights: Weights, config: DepthAnythingConfig) -> None:
        # The file states neither the largest depth of the training nor whether it is metric.
        name = Path(weights.file).name
        limits = [limit for part, limit in _LIMIT_OF_NAME.items() if part in name]
        wanted = f"{' or '.join(_LIMIT_OF_NAME)} in the name of a Depth Anything checkpoint"
        found = f"{name}, whose output may be no metric depth; keep the official name"
        require(bool(config.depth_limit or limits), wanted, found)
        self.depth_limit = config.depth_limit or limits[0]
        self.shorter_side = config.shorter_side
        self.device = weights.device
        self._transformer = VisionTransformer(weights.below("pretrained."))
        self._head = weights.below("depth_head.")

    @torch.no_grad()
    def __call__(self, frame: Frame, camera: Camera) -> Tensor:
        """Return the depth (H, W) in metres that the network sees in an image."""
        seen = normalise(self._resized(frame.image).to(self.device))
        depth = self.depth_limit * torch.sigmoid(self.network(seen))
        return resize(depth[None], frame.image.shape[:2])[0, 0].to(frame.image.device)

    def network(self, image: Tensor) -> Tensor:  # (B, 3, 14 h, 14 w) normalised -> (B, 14 h, 14 w)
        """Return the raw output: its sigmoid is metric depth, its ReLU relative disparity."""
        head, scratch = self._head, self._head.below("scratch.")
        readings = self._transformer(image, _TAPS[self._transformer.depth])
        maps = [head.conv(f"projects.{k}", tokens.patches) for k, tokens in enumerate(readings)]
        # Resolutions of 4, 2, 1 and 1/2 cells per patch side.
        maps[0] = head.upconv("resize_layers.0", maps[0])
        maps[1] = head.upconv("resize_layers.1", maps[1])
        maps[3] = head.conv("resize_layers.3", maps[3], stride=2)
        maps = [scratch.conv(f"layer{k + 1}_rn", m, bias=False) for k, m in enumerate(maps)]

        rows, cols = maps[0].shape[-2:]
        sizes = [(2 * rows, 2 * cols), *(m.shape[-2:] for m in maps[:3])]
        fused = maps[3]
        for k in (3, 2, 1, 0):  # from coarse to fine
            unit = scratch.below(f"refinenet{k + 1}.")
            if k < 3:
                fused = fused + unit.below("resConfUnit1.").residual_unit(maps[k])
            fused = resize(unit.below("resConfUnit2.").residual_unit(fused), sizes[k])
            fused = unit.conv("out_conv", fused)
        out = resize(scratch.conv("output_conv1", fused), image.shape[-2:])
        return scratch.below("output_conv2.").convs(out, channels=(1,))[:, 0]

    def _resized(self, image: Tensor) -> Tensor:
        """Return the image with sides of whole patches, the shorter one of `shorter_side`."""
        scale = max(self.shorter_side / side for side in image.shape[:2])
        patches = [side * scale / PATCH for side in image.shape[:2]]
        least = self.shorter_side / PATCH
        rows, cols = (PATCH * (round(n) if round(n) >= least else math.ceil(n)) for n in patches)
        # In float64, as the official code: float32 weights of the cubic differ in the last digits.
        pixels = image.double().cpu().numpy()
        resized = cv2.resize(pixels, (cols, rows), interpolation=cv2.INTER_CUBIC)
        return torch.from_numpy(resized).float()
