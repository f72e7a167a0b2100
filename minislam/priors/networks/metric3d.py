"""Metric3D v2: the metric depth of the paper (D~ in Eq. (3), Eq. (5) and Eq. (8)).

A near small object and a far large one look the same; only the focal length tells them apart. So
the network answers as if every image came from one "canonical" camera of 1000 px, and the answer
is scaled by the true focal length: that of the image the network SAW, after resizing.

    tokens of the ViT -> 4 maps at 3 resolutions -> fused coarse to fine -> first estimate
    -> a few rounds of recurrent refinement -> 4x upsampling

In the refinement three gated recurrent units (GRU) at three resolutions read the present estimate
and propose a change to it, several times, as in RAFT. The estimate ("state") has six channels:
scaled depth, depth confidence, normal (3), normal confidence.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import require
from minislam.geometry import Camera
from minislam.images import resample
from minislam.parameters import parameter
from minislam.priors.networks.checkpoints import Weights, resize
from minislam.priors.networks.vit import PATCH, VisionTransformer, normalise
from minislam.records import Frame

CANONICAL_FOCAL = 1000.0  # px, of the camera that all training images were turned into
LARGEST_SCALED = 300.0  # world units (metre); the official cut of the scaled depth
NETWORK_SIZE = (616, 1064)  # px (height, width), as in the training
_SIZE_STEP = 2 * PATCH  # px; the 3.5-fold upsampling to the finest map needs an even grid
_ROUNDS = {12: 4, 24: 8}  # of refinement, by the number of blocks of the ViT (S, L)
_NEAREST, _FARTHEST = 0.1, 200.0  # metre, range of the canonical depth
_BINS = 256  # of depth, between the two on a logarithmic scale
_STATE_UNIT = 100.0  # metre per unit of the state's depth channel
_EPSILON = 1e-5  # of the layer norms in the convolutional part
_MASK_SCALE = 0.25  # of the upsampling logits, as in RAFT


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
        is_whole = all(side >= _SIZE_STEP and side % _SIZE_STEP == 0 for side in network_size)
        found = f"{network_size}; the one of the training is {NETWORK_SIZE}"
        require(is_whole, f"a network size of multiples of {_SIZE_STEP} px", found)
        self.network_size = network_size
        self.device = weights.device
        # It has registers, yet resizes its positions like the networks without.
        self._transformer = VisionTransformer(weights.below("depth_model.encoder."))
        self._decoder = weights.below("depth_model.decoder.")
        self._rounds = _ROUNDS[self._transformer.depth]

    def __call__(self, frame: Frame, camera: Camera) -> Tensor:
        """Return the depth (H, W) in metres of an image taken by a camera."""
        canonical, scale = self.canonical_depth(frame.image)
        metric = resample(canonical, *frame.image.shape[:2]) * (camera.fx * scale / CANONICAL_FOCAL)
        return metric.clamp(0, LARGEST_SCALED).to(frame.image.device)

    @torch.no_grad()
    def canonical_depth(self, image: Tensor) -> tuple[Tensor, float]:
        """Return the depth of a 1000 px camera at the network's scale, and that scale."""
        padded, inside, scale = fit(image.to(self.device), self.network_size)
        return self.network(padded)[0][inside], scale

    def network(self, image: Tensor) -> Tensor:  # (B, 3, 28 h, 28 w) -> (B, 28 h, 28 w) metre
        """Return the depth for the canonical camera, of a normalised image."""
        fine, middle, coarse, coarsest = self.maps(image)
        # The fusion of the official code rectifies its inputs in place: the skip of each unit, and
        # the middle and coarse maps that the refinement sees. The published weights rely on it.
        middle, coarse, coarsest = middle.relu(), coarse.relu(), coarsest.relu()
        weights = self._decoder.below("decoder_mono.")
        level = weights.below("upconv_3.")
        fused = level.conv("out_conv", level.below("way_trunk.").residual_unit(coarsest))
        doubled = [2 * side for side in coarse.shape[-2:]]
        branches = {"upconv_2.": (coarse, doubled), "upconv_1.": (middle, fine.shape[-2:])}
        for name, (branch, size) in branches.items():
            level = weights.below(name)
            fused = (fused + level.below("way_branch.").residual_unit(branch)).relu()
            fused = resize(level.below("way_trunk.").residual_unit(fused), size)
            fused = level.conv("out_conv", fused)
        return _refine(self._decoder, fused, [fine, middle, coarse], self._rounds)

    def maps(self, image: Tensor) -> tuple[Tensor, ...]:  # 4 x (B, C_l, H/s, W/s)
        """Return maps at s = 4, 7, 14 and 14 px, all from the last tokens of (B, 3, H, W)."""
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


def fit(
    image: Tensor,  # (H, W, 3)
    size: tuple[int, int],  # px
) -> tuple[Tensor, tuple[slice, slice], float]:  # (1, 3, *size) normalised, network px per px
    """Return an image padded to a size, its aspect kept; the part where it lies; its scale."""
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    # The small number protects from 616 * (1 - 1e-16) being cut to 615.
    rows, cols = (max(1, int(side * scale + 1e-6)) for side in image.shape[:2])
    resized = functional.interpolate(normalise(image), (rows, cols), mode="bilinear")
    top, left = (size[0] - rows) // 2, (size[1] - cols) // 2
    padding = (left, size[1] - cols - left, top, size[0] - rows - top)
    padded = functional.pad(resized, padding)  # 0 is the mean colour of a normalised image
    return padded, (slice(top, top + rows), slice(left, left + cols)), scale


def _refine(
    weights: Weights,  # of the decoder
    features: Tensor,  # (B, c0 + 2, h, w), the last two channels are confidences
    context: list[Tensor],  # three maps (B, c, h_l, w_l), from fine to coarse
    rounds: int,
) -> Tensor:  # (B, H, W) metre
    """Return the refined and upsampled depth for the canonical camera."""
    state = _first_estimate(weights, features)
    hidden, gates = [], []  # of the units; what the context adds to their three gates
    for level, seen in enumerate(context):
        encoder = weights.below(f"context_feature_encoder.outputs{4 * 2**level:02d}.")
        hidden.append(_context_head(encoder.below("0."), seen).tanh())
        offsets = _context_head(encoder.below("1."), seen).relu()
        gates.append(weights.conv(f"context_zqr_convs.{level}", offsets).chunk(3, 1))
    update = weights.below("update_block.")
    for _ in range(rounds):
        hidden = _recurrent_round(update, hidden, gates, state)
        head = update.below("flow_head.")
        depth = head.conv("conv2d", head.conv("conv1d", hidden[0]).relu(), channels=(2,))
        normal = head.conv("conv2n", head.conv("conv1n", hidden[0]).relu(), channels=(4,))
        state = state + torch.cat([depth, normal], 1)
    mask = update.below("mask.").convs(hidden[0])
    fine = convex_upsample(state[:, :1], _MASK_SCALE * mask, factor=4)[:, 0]
    return (_STATE_UNIT * fine + _FARTHEST).clamp(_NEAREST, _FARTHEST)


def _first_estimate(weights: Weights, features: Tensor) -> Tensor:  # (B, 6, h, w)
    """Return the state before refinement: depth is an expectation over logarithmic bins."""
    features, depth_confidence, normal_confidence = features.tensor_split([-2, -1], 1)
    logits = weights.below("depth_regressor.").convs(features, channels=(_BINS,))
    bins = torch.linspace(math.log(_NEAREST), math.log(_FARTHEST), _BINS, device=features.device)
    depth = torch.einsum("bkhw,k->bhw", logits.softmax(1), bins.exp())[:, None]
    depth = depth.clamp(_NEAREST, _FARTHEST)
    normal = weights.below("normal_predictor.").convs(features, layers=4, channels=(3,))
    unit = normal / (normal.norm(dim=1, keepdim=True) + 1e-10)
    positive = functional.elu(normal_confidence) + 1.01
    return torch.cat([(depth - _FARTHEST) / _STATE_UNIT, depth_confidence, unit, positive], 1)


def _context_head(weights: Weights, x: Tensor) -> Tensor:
    unit = weights.below("0.")
    y = _channel_norm(unit, "norm1", unit.conv("conv1", x)).relu()
    y = _channel_norm(unit, "norm2", unit.conv("conv2", y)).relu()
    skip = _channel_norm(unit, "downsample.1", unit.conv("downsample.0", x))
    return weights.conv("1", (skip + y).relu())


def _channel_norm(weights: Weights, name: str, x: Tensor) -> Tensor:
    """Normalise over the channels of each pixel of (B, C, h, w)."""
    return weights.layer_norm(name, x.movedim(1, -1), _EPSILON).movedim(-1, 1)


def _recurrent_round(
    weights: Weights, hidden: list[Tensor], gates: list[tuple[Tensor, ...]], state: Tensor
) -> list[Tensor]:
    """Update the coarsest unit three times, the middle one twice, the finest once."""
    fine, middle, coarse = hidden
    size = middle.shape[-2:]
    # They are called by twice their level's stride.
    of_fine, of_middle, of_coarse = (weights.below(f"gru{n}.") for n in ("08", "16", "32"))
    coarse = of_coarse.gru(coarse, _halved(middle), gates[2])
    for _ in range(2):
        coarse = of_coarse.gru(coarse, _halved(middle), gates[2])
        seen = torch.cat([resize(_halved(fine), size), resize(coarse, size)], 1)
        middle = of_middle.gru(middle, seen, gates[1])
    fine = of_fine.gru(fine, torch.cat([state, resize(middle, fine.shape[-2:])], 1), gates[0])
    return [fine, middle, coarse]


def _halved(x: Tensor) -> Tensor:
    return functional.avg_pool2d(x, 3, stride=2, padding=1)  # counts the padding as zeros


def convex_upsample(
    coarse: Tensor,  # (B, C, h, w)
    logits: Tensor,  # (B, 9 * factor^2, h, w)
    factor: int,
) -> Tensor:  # (B, C, factor * h, factor * w)
    """Upsample: each fine pixel is a convex combination of the 3x3 coarse ones around it (RAFT)."""
    weight = logits.unflatten(1, (1, 9, factor, factor)).softmax(2)
    around = functional.unfold(coarse, 3, padding=1).unflatten(2, coarse.shape[2:])
    fine = (weight * around.unflatten(1, (-1, 9, 1, 1))).sum(2)  # (B, C, factor, factor, h, w)
    return functional.pixel_shuffle(fine.flatten(1, 3), factor)
