"""The network of DROID-SLAM: it corrects the expected position of each cell in another frame.

    image -> features (compared between frames) and context (of the source frame)
    expected position -> correlation of the features around it
    correlation, motion, context -> recurrent unit -> revision of the position, confidence

All positions and lengths in this file are in cells (1 cell = 8 px); droid.py converts them to px.
"""

import torch
from torch import Tensor
from torch.nn import functional

from minislam.priors.networks.checkpoints import Weights

STRIDE = 8  # px per cell, fixed by the three halvings of the encoders
CHANNELS = 128  # of features, hidden state and context
LEVELS = 4  # of the correlation pyramid
_HEAD = (2, 3)  # channels; a third of some checkpoints was of use in the training only
RADIUS = 3  # cells looked at around the expected position, at every level
_DAMPING_SCALE = 0.01  # of eta, as in the training
_MOTION_LIMIT = 64.0  # cells; motions are cut there, as in the training


def encode_features(weights: Weights, image: Tensor) -> Tensor:  # (B, 128, h, w)
    """Return what is compared between frames, of normalised images (B, 3, H, W)."""
    return _encode(weights.below("fnet."), image, normalised=True)


def encode_context(weights: Weights, image: Tensor) -> tuple[Tensor, Tensor]:  # (B, 128, h, w)
    """Return what a source needs: the first hidden state, and the context of all its updates."""
    both = _encode(weights.below("cnet."), image, normalised=False)
    return both[:, :CHANNELS].tanh(), both[:, CHANNELS:].relu()


def _encode(weights: Weights, x: Tensor, normalised: bool) -> Tensor:
    """Halve the image three times with residual blocks: (B, 3, H, W) -> (B, C, H/8, W/8)."""

    def norm(y: Tensor) -> Tensor:
        return functional.instance_norm(y) if normalised else y

    with weights.autocast():
        x = norm(weights.conv("conv1", x, stride=2)).relu()
        for stage in (1, 2, 3):
            for block in (0, 1):
                part = weights.below(f"layer{stage}.{block}.")
                stride = 2 if stage > 1 and block == 0 else 1
                y = norm(part.conv("conv1", x, stride)).relu()
                y = norm(part.conv("conv2", y)).relu()
                skip = norm(part.conv("downsample.0", x, stride)) if stride == 2 else x
                x = (skip + y).relu()
        return weights.conv("conv2", x, channels=(CHANNELS if normalised else 2 * CHANNELS,))


def correlation_pyramid(source: Tensor, target: Tensor) -> list[Tensor]:  # features (E, C, h, w)
    """Compare every source cell with every target cell; average the targets level by level."""
    edges, _, height, width = source.shape
    # Each side is divided by 4, so the product by 16: the scale the network was trained with.
    volume = torch.einsum("ecn,ecm->enm", source.flatten(2) / 4, target.flatten(2) / 4)
    pyramid = [volume.reshape(edges * height * width, 1, height, width)]
    for _ in range(LEVELS - 1):
        pyramid.append(functional.avg_pool2d(pyramid[-1], 2))
    return pyramid  # per level l (E * h * w, 1, h / 2^l, w / 2^l)


def look_up(
    pyramid: list[Tensor],
    positions: Tensor,  # (E, h, w, 2) cells in the target
) -> Tensor:  # (E, 4 * 49, h, w)
    """Return the correlations in a 7x7 window around positions, at every level, 0 outside."""
    edges, height, width, _ = positions.shape
    steps = torch.arange(-RADIUS, RADIUS + 1, dtype=positions.dtype, device=positions.device)
    # The offset in u changes slowest: that is the order of the trained channels.
    window = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), -1)  # (7, 7, 2)
    centres = positions.reshape(-1, 1, 1, 2)
    levels = []
    for level, volume in enumerate(pyramid):
        size = positions.new_tensor([volume.shape[3], volume.shape[2]])
        # grid_sample counts from -1 to 1 between the outer edges of the outermost cells.
        sampled_at = (2 * (centres / 2**level + window) + 1) / size - 1
        levels.append(functional.grid_sample(volume, sampled_at, align_corners=False))
    found = torch.cat(levels, 1)  # (E * h * w, 4, 7, 7)
    return found.reshape(edges, height, width, -1).permute(0, 3, 1, 2)


def update(
    weights: Weights,
    source: Tensor,  # (E, 128, h, w) features
    target: Tensor,  # (E, 128, h, w) features
    hidden: Tensor,  # (E, 128, h, w)
    context: Tensor,  # (E, 128, h, w) of the source
    expected: Tensor,  # (E, h, w, 2) cells in the target, by the present geometry
    last_target: Tensor,  # (E, h, w, 2) cells, the answer of the last update
) -> tuple[Tensor, Tensor, Tensor]:  # (E, 128, h, w), (E, h, w, 2) cells, (E, h, w, 2) in (0, 1)
    """Return the new hidden state, the corrected positions, and their confidences for u and v."""
    parts = weights.below("update.")
    motion = torch.cat([expected - cell_grid(expected), last_target - expected], -1)
    motion = motion.clamp(-_MOTION_LIMIT, _MOTION_LIMIT).permute(0, 3, 1, 2)
    with weights.autocast():
        correlation = look_up(correlation_pyramid(source, target), expected)
        compared = parts.below("corr_encoder.").convs(correlation).relu()
        moved = parts.below("flow_encoder.").convs(motion).relu()
        unit = parts.below("gru.")
        # Every cell also gets a gated mean over the whole image.
        mean = (unit.conv("w", hidden).sigmoid() * hidden).mean((2, 3), keepdim=True)
        offsets = [unit.conv(f"conv{gate}_glo", mean) for gate in "zrq"]  # (E, 128, 1, 1) each
        hidden = unit.gru(hidden, torch.cat([context, compared, moved], 1), offsets)
        revision = parts.below("delta.").convs(hidden, channels=_HEAD)[:, :2]
        confidence = parts.below("weight.").convs(hidden, channels=_HEAD)[:, :2].sigmoid()
    revision, confidence = (x.permute(0, 2, 3, 1) for x in (revision, confidence))
    return hidden.float(), expected + revision, confidence.float()


def damping(weights: Weights, hidden: Tensor) -> Tensor:  # (E, 128, h, w) -> (h, w)
    """Return eta from the edges of one source: how a bundle adjustment damps its disparities."""
    part = weights.below("update.agg.")
    with weights.autocast():
        seen = part.conv("conv1", hidden).relu().mean(0, keepdim=True)
        features = part.conv("conv2", seen).relu()
        eta = functional.softplus(part.conv("eta.0", features))[0, 0]
    return (_DAMPING_SCALE * eta).float()


def cell_grid(like: Tensor) -> Tensor:  # (h, w, 2) cells
    """Return the position (u, v) of every cell of a map (E, h, w, 2)."""
    height, width = like.shape[1:3]
    sides = (torch.arange(side, dtype=like.dtype, device=like.device) for side in (width, height))
    return torch.stack(torch.meshgrid(*sides, indexing="xy"), -1)
