"""The second half of Metric3D v2: a first estimate, refined by recurrent units, then upsampled.

As in RAFT, three gated recurrent units (GRU) at three resolutions read the present estimate and
propose a change to it, several times. The estimate ("state") has six channels: scaled depth, depth
confidence, normal (3), normal confidence.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from minislam.priors.networks.checkpoints import Weights, resize

NEAREST, FARTHEST = 0.1, 200.0  # metre, range of the canonical depth
_BINS = 256  # of depth, between the two on a logarithmic scale
_STATE_UNIT = 100.0  # metre per unit of the state's depth channel
_EPSILON = 1e-5  # of the layer norms in the convolutional part
_UPSAMPLING = 4
_MASK_SCALE = 0.25  # of the upsampling logits, as in RAFT
# From fine to coarse; the GRUs are called by twice their level's stride.
_CONTEXT_NAMES = ("outputs04", "outputs08", "outputs16")
_GRU_NAMES = ("gru08", "gru16", "gru32")


def refine(
    weights: Weights,  # of the decoder
    features: Tensor,  # (B, c0 + 2, h, w), the last two channels are confidences
    context: list[Tensor],  # three maps (B, c, h_l, w_l), from fine to coarse
    rounds: int,
) -> Tensor:  # (B, H, W) metre
    """Return the refined and upsampled depth for the canonical camera."""
    state = _first_estimate(weights, features[:, :-2], features[:, -2:-1], features[:, -1:])
    hidden, gates = [], []  # of the units; what the context adds to their three gates
    for level, (name, seen) in enumerate(zip(_CONTEXT_NAMES, context, strict=True)):
        encoder = weights.below(f"context_feature_encoder.{name}.")
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
    fine = convex_upsample(state[:, :1], _MASK_SCALE * mask, _UPSAMPLING)[:, 0]
    return (_STATE_UNIT * fine + FARTHEST).clamp(NEAREST, FARTHEST)


def _first_estimate(
    weights: Weights, features: Tensor, depth_confidence: Tensor, normal_confidence: Tensor
) -> Tensor:  # (B, 6, h, w)
    """Return the state before refinement: depth is an expectation over logarithmic bins."""
    logits = weights.below("depth_regressor.").convs(features, channels=(_BINS,))
    bins = torch.linspace(math.log(NEAREST), math.log(FARTHEST), _BINS, device=features.device)
    depth = torch.einsum("bkhw,k->bhw", logits.softmax(1), bins.exp())[:, None]
    depth = depth.clamp(NEAREST, FARTHEST)
    normal = weights.below("normal_predictor.").convs(features, layers=4, channels=(3,))
    unit = normal / (normal.norm(dim=1, keepdim=True) + 1e-10)
    positive = functional.elu(normal_confidence) + 1.01
    return torch.cat([(depth - FARTHEST) / _STATE_UNIT, depth_confidence, unit, positive], 1)


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

    def gru(level: int, h: Tensor, *inputs: Tensor) -> Tensor:
        unit = weights.below(f"{_GRU_NAMES[level]}.")
        return unit.gru(h, torch.cat(inputs, 1), gates[level])

    coarse = gru(2, coarse, _halved(middle))
    for _ in range(2):
        coarse = gru(2, coarse, _halved(middle))
        middle = gru(1, middle, resize(_halved(fine), size), resize(coarse, size))
    fine = gru(0, fine, state, resize(middle, fine.shape[-2:]))
    return [fine, middle, coarse]


def _halved(x: Tensor) -> Tensor:
    return functional.avg_pool2d(x, 3, stride=2, padding=1)  # counts the padding as zeros


def convex_upsample(
    coarse: Tensor,  # (B, C, h, w)
    logits: Tensor,  # (B, 9 * factor^2, h, w)
    factor: int,
) -> Tensor:  # (B, C, factor * h, factor * w)
    """Upsample: each fine pixel is a convex combination of the 3x3 coarse ones around it (RAFT)."""
    batch, channels, height, width = coarse.shape
    weight = logits.view(batch, 1, 9, factor, factor, height, width).softmax(2)
    around = functional.unfold(coarse, 3, padding=1).view(batch, channels, 9, 1, 1, height, width)
    fine = (weight * around).sum(2)  # (B, C, factor, factor, h, w)
    return fine.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, factor * height, factor * width)
