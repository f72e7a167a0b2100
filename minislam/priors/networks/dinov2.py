"""DINOv2 and FiT3D: the features of the paper's uncertainty MLP.

FiT3D is DINOv2 made consistent across views; its files come in the layout of the timm library.
"""

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.priors.networks.checkpoints import (
    Weights,
    is_timm_layout,
    load_checkpoint,
    probed,
    require,
)
from minislam.priors.networks.vit import PATCH, PositionResize, VisionTransformer, normalise
from minislam.records import Frame


class DinoFeatures:
    """The patch tokens of the last block, after the final norm: a `FeatureExtractor`."""

    stride = PATCH

    def __init__(self, weights: Weights, kind: str = "DINOv2 or FiT3D") -> None:
        require(weights, kind)
        self.device = weights.device
        self._transformer = VisionTransformer(weights, position_resize_of(weights))
        self.dimension = self._transformer.width

    def __call__(
        self,
        frame: Frame,
    ) -> Tensor:  # (H // 14, W // 14, C) float32
        """Return one feature per patch of 14 px; the image is stretched to whole patches."""
        image = frame.image
        rows, cols = image.shape[0] // PATCH, image.shape[1] // PATCH
        if min(rows, cols) < 1:
            raise InputError(
                f"expected an image of at least {PATCH}x{PATCH} px for the features, "
                f"found {image.shape[1]}x{image.shape[0]}; give a larger working size"
            )
        with torch.no_grad():
            size = (PATCH * rows, PATCH * cols)
            whole = functional.interpolate(normalise(image, self.device), size, mode="bilinear")
            patches = self._transformer(whole)[0].patches[0]
        return patches.permute(1, 2, 0).to(image.device)


def position_resize_of(weights: Weights) -> PositionResize:
    """Return how a features checkpoint was trained to resize its positions.

    The file does not say so, but the three published kinds differ in what it contains.
    """
    antialias = is_timm_layout(weights) or "register_tokens" in weights
    return PositionResize.ANTIALIAS if antialias else PositionResize.OFFSET


def load_dino_features(
    path: Path | str,
    device: torch.device | str = "cpu",
    kind: str = "DINOv2 or FiT3D",  # what the file must hold
) -> DinoFeatures:
    """Read a DINOv2 or FiT3D checkpoint and check it."""
    return checked_dino_features(load_checkpoint(path, device), kind)


def checked_dino_features(weights: Weights, kind: str = "DINOv2 or FiT3D") -> DinoFeatures:
    """Return the features after their weights have been checked on a tiny image."""

    def build_and_run() -> DinoFeatures:
        features = DinoFeatures(weights, kind)
        features(Frame(0, 0.0, torch.zeros(PATCH, PATCH, 3)))
        return features

    return probed(weights, build_and_run, ignored=("mask_token",))  # used in training only
