"""DINOv2 and FiT3D: the features of the paper's uncertainty MLP.

FiT3D is DINOv2 made consistent across views; its files come in the layout of the timm library.
"""

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.priors.features import grid_size
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame


class DinoFeatures:
    """The patch tokens of the last block, after the final norm: a `FeatureExtractor`."""

    stride = PATCH

    def __init__(self, weights: Weights) -> None:
        self.device = weights.device
        self._transformer = VisionTransformer(weights, is_antialiased(weights))
        self.dimension = self._transformer.width

    def __call__(self, frame: Frame) -> Tensor:  # (H // 14, W // 14, C) float32
        """Return one feature per patch of 14 px; the image is stretched to whole patches."""
        image = frame.image
        rows, cols = grid_size(image, PATCH)
        with torch.no_grad():
            size = (PATCH * rows, PATCH * cols)
            whole = functional.interpolate(normalise(image, self.device), size, mode="bilinear")
            patches = self._transformer(whole)[0].patches[0]
        return patches.permute(1, 2, 0).to(image.device)


def is_antialiased(weights: Weights) -> bool:
    """Tell whether a features checkpoint was trained with antialiased positions.

    The file does not state it, but the three published kinds differ in what they contain: FiT3D
    alone lacks the mask token of the training, and DINOv2 has registers or not. A file that has
    lost such a tensor looks like another kind; then its official name tells.
    """
    name = Path(weights.file).name
    is_fit3d = "mask_token" not in weights
    has_registers = "register_tokens" in weights or "reg_token" in weights
    lacks_mask = is_fit3d and ("dinov2_vit" in name or "register_tokens" in weights)
    if lacks_mask or ("_reg" in name and not has_registers):
        lost = "mask_token" if lacks_mask else "register tokens"
        raise InputError(f"expected {lost} in {weights.file}, found none; the file is not complete")
    return is_fit3d or has_registers
