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
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.metric3d_refinement import refine
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame

CANONICAL_FOCAL = 1000.0  # px, of the camera that all training images were turned into
FARTHEST = 300.0  # world units (metre); the official cut of the scaled depth
NETWORK_SIZE = (616, 1064)  # px (height, width), as in the training
_SIZE_STEP = 2 * PATCH  # px; the 3.5-fold upsampling of the coarsest map needs an even grid
_SMALL, _LARGE = 384, 1024  # width of the ViT
_ROUNDS = {_SMALL: 4, _LARGE: 8}  # of refinement


@dataclass(frozen=True)
class Metric3DConfig:
    """Size of the input."""

    size: tuple[int, int] = parameter(
        NETWORK_SIZE,
        "rows and columns it sees [px], official; multiples of 28, half costs a fifth",
        1,
    )


@dataclass(frozen=True)
class Pyramid:
    """Feature maps of one image, named by their resolution."""

    fine: Tensor  # (B, c0, 2/7 H, 2/7 W)
    middle: Tensor  # (B, c1, 1/7 H, 1/7 W)
    coarse: Tensor  # (B, C, 1/14 H, 1/14 W)
    coarsest_context: Tensor  # (B, C, 1/14 H, 1/14 W), where the fusion starts


class Metric3D:
    """The network: a normalised image in, depth for the canonical camera out."""

    def __init__(self, weights: Weights) -> None:
        encoder = weights.below("depth_model.encoder.")
        # It has registers, yet resizes its positions like the networks without.
        self.transformer = VisionTransformer(encoder)
        self.weights = weights.below("depth_model.decoder.")
        width = self.transformer.width
        if width not in _ROUNDS:
            raise InputError(
                f"expected Metric3D v2 with a ViT of width {_SMALL} or {_LARGE}, found "
                f"{width} in {weights.file}; give the small or the large one"
            )
        self.rounds = _ROUNDS[width]

    def __call__(
        self,
        image: Tensor,  # (B, 3, H, W) normalised, H and W multiples of 28
    ) -> Tensor:  # (B, H, W) metre
        """Return the depth for the canonical camera."""
        pyramid = self.pyramid(image)
        features = _fuse(self.weights.below("decoder_mono."), pyramid)
        # The fusion of the official code rectifies its inputs in place, so its refinement sees
        # the middle and coarse maps rectified, too. The published weights rely on it.
        context = [pyramid.fine, pyramid.middle.relu(), pyramid.coarse.relu()]
        return refine(self.weights, features, context, self.rounds)

    def pyramid(self, image: Tensor) -> Pyramid:
        """Return the four maps, all computed from the tokens of the last block."""
        tokens = self.transformer(image)[0]
        weights = self.weights.below("token2feature.")
        readings = []
        for k in range(4):
            reader = weights.below(f"read_{k}.readoper.")
            patches = reader.linear("project_patch", tokens.patches.movedim(1, -1))
            leading = reader.linear("project_learn", tokens.leading.flatten(1), bias=False)
            readings.append(functional.gelu(patches + leading[:, None, None]).movedim(-1, 1))
        upsampled = functional.interpolate(readings[0], scale_factor=3.5, mode="nearest")
        return Pyramid(
            fine=weights.conv("read_0.sample.0", upsampled),
            middle=weights.upconv("read_1.sample", readings[1]),
            coarse=readings[2],
            coarsest_context=readings[3],
        )


def _fuse(weights: Weights, pyramid: Pyramid) -> Tensor:
    """Return the fused features and two confidences (B, c0 + 2, 2/7 H, 2/7 W)."""
    rows, cols = pyramid.coarse.shape[-2:]
    level = weights.below("upconv_3.")
    fused = level.conv("out_conv", _unit(level.below("way_trunk."), pyramid.coarsest_context))
    steps = [
        ("upconv_2.", pyramid.coarse, (2 * rows, 2 * cols)),
        ("upconv_1.", pyramid.middle, tuple(pyramid.fine.shape[-2:])),
    ]
    for name, branch, size in steps:
        level = weights.below(name)
        fused = _unit(level.below("way_trunk."), fused + _unit(level.below("way_branch."), branch))
        fused = functional.interpolate(fused, size, mode="bilinear", align_corners=True)
        fused = level.conv("out_conv", fused)
    return fused


def _unit(weights: Weights, x: Tensor) -> Tensor:
    """Apply a residual unit whose skip is rectified, too (an in-place ReLU in the original)."""
    x = x.relu()
    return x + weights.conv("conv2", weights.conv("conv1", x).relu())


@dataclass(frozen=True)
class Fitted:
    """How an image was brought to the network's size."""

    image: Tensor  # (1, 3, H_net, W_net) normalised
    rows: slice  # where the image lies; the rest has the mean colour
    cols: slice
    scale: float  # network px per image px


def fit(image: Tensor, size: tuple[int, int], device: torch.device) -> Fitted:
    """Resize an image (H, W, 3) with its aspect kept; pad it to the network's size."""
    height, width = image.shape[:2]
    scale = min(size[0] / height, size[1] / width)
    # The small number protects from 616 * (1 - 1e-16) being cut to 615.
    inner = (max(1, int(height * scale + 1e-6)), max(1, int(width * scale + 1e-6)))
    resized = functional.interpolate(normalise(image, device), inner, mode="bilinear")
    top, left = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    padding = (left, size[1] - inner[1] - left, top, size[0] - inner[0] - top)
    padded = functional.pad(resized, padding)  # 0 is the mean colour of a normalised image
    return Fitted(padded, slice(top, top + inner[0]), slice(left, left + inner[1]), scale)


class Metric3DDepth:
    """Metric depth by Metric3D v2: a `DepthPrior`."""

    def __init__(
        self,
        weights: Weights,
        network_size: tuple[int, int] = NETWORK_SIZE,  # px; half of it costs a fifth
    ) -> None:
        if any(side < _SIZE_STEP or side % _SIZE_STEP for side in network_size):
            raise InputError(
                f"expected a network size of multiples of {_SIZE_STEP} px, found {network_size}; "
                f"the one of the training is {NETWORK_SIZE}"
            )
        self.network_size = network_size
        self.device = weights.device
        self.network = Metric3D(weights)

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


def build_metric3d(weights: Weights, config: Metric3DConfig) -> Metric3DDepth:
    """Return the prior after one run on a tiny image, which asks for every tensor it needs."""
    prior = Metric3DDepth(weights, config.size)
    prior.network(torch.zeros(1, 3, _SIZE_STEP, _SIZE_STEP, device=weights.device))
    return prior
