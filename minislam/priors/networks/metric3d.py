"""Metric3D v2: the metric depth of the paper (D~ in Eq. (3), Eq. (4) and Eq. (5)).

A near small object and a far large one look the same; only the focal length tells them apart. So
the network answers as if every image came from one "canonical" camera of 1000 px, and the answer
is scaled by the true focal length: that of the image the network SAW, after resizing.

    tokens of the ViT -> 4 maps at 3 resolutions -> fused coarse to fine -> first estimate
    -> a few rounds of recurrent refinement (metric3d_refinement.py) -> 4x upsampling
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.parameters import parameter
from minislam.priors.networks.checkpoints import Weights, resize
from minislam.priors.networks.metric3d_refinement import refine
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame

CANONICAL_FOCAL = 1000.0  # px, of the camera that all training images were turned into
FARTHEST = 300.0  # world units (metre); the official cut of the scaled depth
NETWORK_SIZE = (616, 1064)  # px (height, width), as in the training
_SIZE_STEP = 2 * PATCH  # px; the 3.5-fold upsampling of the coarsest map needs an even grid
_ROUNDS = {384: 4, 1024: 8}  # of refinement, by the width of the ViT (S, L)


@dataclass(frozen=True)
class Metric3DConfig:
    """Size of the input."""

    size: tuple[int, int] = parameter(
        NETWORK_SIZE,
        "rows and columns it sees [px], official; multiples of 28, half costs a fifth",
        1,
    )


class Metric3DDepth:
    """Metric depth by Metric3D v2: a `DepthPrior`."""

    def __init__(self, weights: Weights, network_size: tuple[int, int] = NETWORK_SIZE) -> None:
        if any(side < _SIZE_STEP or side % _SIZE_STEP for side in network_size):
            raise InputError(
                f"expected a network size of multiples of {_SIZE_STEP} px, found {network_size}; "
                f"the one of the training is {NETWORK_SIZE}"
            )
        self.network_size = network_size
        self.device = weights.device
        # It has registers, yet resizes its positions like the networks without.
        self._transformer = VisionTransformer(weights.below("depth_model.encoder."))
        self._decoder = weights.below("depth_model.decoder.")
        width = self._transformer.width
        if width not in _ROUNDS:
            raise InputError(
                f"expected Metric3D v2 with a ViT of width {' or '.join(map(str, _ROUNDS))}, found "
                f"{width} in {weights.file}; give the small or the large one"
            )
        self._rounds = _ROUNDS[width]

    def __call__(self, frame: Frame, camera: Camera) -> Tensor:
        """Return the depth (H, W) in metres of an image taken by a camera."""
        canonical, scale = self.canonical_depth(frame.image)
        size = tuple(frame.image.shape[:2])
        full = functional.interpolate(canonical[None, None], size, mode="bilinear")[0, 0]
        metric = full * (camera.fx * scale / CANONICAL_FOCAL)
        return metric.clamp(0, FARTHEST).to(frame.image.device)

    def canonical_depth(self, image: Tensor) -> tuple[Tensor, float]:
        """Return the depth of a 1000 px camera at the network's scale, and that scale."""
        with torch.no_grad():
            fitted = fit(image, self.network_size, self.device)
            depth = self.network(fitted.image)[0, fitted.rows, fitted.cols]
        return depth, fitted.scale

    def network(
        self,
        image: Tensor,  # (B, 3, H, W) normalised, H and W multiples of 28
    ) -> Tensor:  # (B, H, W) metre
        """Return the depth for the canonical camera."""
        fine, middle, coarse, coarsest = self.maps(image)
        # The fusion of the official code rectifies its inputs in place: the skip of each unit, and
        # the middle and coarse maps that the refinement sees. The published weights rely on it.
        middle, coarse, coarsest = middle.relu(), coarse.relu(), coarsest.relu()
        weights = self._decoder.below("decoder_mono.")
        level = weights.below("upconv_3.")
        fused = level.conv("out_conv", level.below("way_trunk.").residual_unit(coarsest))
        doubled = [2 * side for side in coarse.shape[-2:]]
        for name, branch, size in (
            ("upconv_2.", coarse, doubled),
            ("upconv_1.", middle, fine.shape[-2:]),
        ):
            level = weights.below(name)
            fused = (fused + level.below("way_branch.").residual_unit(branch)).relu()
            fused = resize(level.below("way_trunk.").residual_unit(fused), size)
            fused = level.conv("out_conv", fused)
        return refine(self._decoder, fused, [fine, middle, coarse], self._rounds)

    def maps(
        self,
        image: Tensor,  # (B, 3, H, W) normalised
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # (B, C_l, H/s, W/s), s = 3.5, 7, 14 and 14 px
        """Return maps at three resolutions, all from the last tokens; the fusion starts at two."""
        tokens = self._transformer(image)[0]
        weights = self._decoder.below("token2feature.")
        readings = []
        for k in range(4):
            reader = weights.below(f"read_{k}.readoper.")
            patches = reader.linear("project_patch", tokens.patches.movedim(1, -1))
            leading = reader.linear("project_learn", tokens.leading.flatten(1), bias=False)
            readings.append(functional.gelu(patches + leading[:, None, None]).movedim(-1, 1))
        upsampled = functional.interpolate(readings[0], scale_factor=3.5, mode="nearest")
        fine = weights.conv("read_0.sample.0", upsampled)
        return fine, weights.upconv("read_1.sample", readings[1]), readings[2], readings[3]


@dataclass(frozen=True)
class Fitted:
    """How an image was brought to the network's size."""

    image: Tensor  # (1, 3, H_net, W_net) normalised
    rows: slice  # where the image lies; the rest has the mean colour
    cols: slice
    scale: float  # network px per image px


def fit(image: Tensor, size: tuple[int, int], device: torch.device) -> Fitted:
    """Resize an image (H, W, 3) with its aspect kept; pad it to the network's size."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    # The small number protects from 616 * (1 - 1e-16) being cut to 615.
    rows, cols = (max(1, int(side * scale + 1e-6)) for side in image.shape[:2])
    resized = functional.interpolate(normalise(image, device), (rows, cols), mode="bilinear")
    top, left = (size[0] - rows) // 2, (size[1] - cols) // 2
    padding = (left, size[1] - cols - left, top, size[0] - rows - top)
    padded = functional.pad(resized, padding)  # 0 is the mean colour of a normalised image
    return Fitted(padded, slice(top, top + rows), slice(left, left + cols), scale)
