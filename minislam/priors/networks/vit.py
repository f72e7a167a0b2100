"""The vision transformer of DINOv2, and the features of the paper's uncertainty MLP.

FiT3D is DINOv2 made consistent across views, in timm's layout. Both depth networks are built on it.

Patches of 14x14 px become tokens; one class token, and in some checkpoints four "registers", stand
before them. A block adds to each token what it reads from all (attention), then an MLP's output:

    x <- x + ls1 * proj(attention(norm1(x)))
    x <- x + ls2 * fc2(gelu(fc1(norm2(x))))
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import require
from minislam.priors.networks.checkpoints import Weights
from minislam.records import Frame

PATCH = 14  # px
_BLOCKS = {384: 12, 768: 12, 1024: 24}  # by the width of ViT-S, -B and -L
_HEAD_WIDTH = 64  # channels per attention head, at every size of the network
_EPSILON = 1e-6  # of every layer norm of the transformer; torch's default is another
_TRAINED_GRID = 37  # patches per side of the 518 px images of the training
# The table of positions is resized for other images as in training, and no checkpoint says how:
# with antialiasing (registers, FiT3D), or by (n + _OFFSET) / 37 (DINOv2, the depth networks).
_OFFSET = 0.1  # patches

_IMAGENET_MEAN = (0.485, 0.456, 0.406)  # RGB, of the images all these networks were trained on
_IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Tokens:
    """The output of a block of the transformer, after the final norm."""

    leading: Tensor  # (B, 1 + registers, C), the class token first
    patches: Tensor  # (B, C, rows, cols)


class VisionTransformer:
    """A ViT-S, -B or -L with patches of 14 px, in the layout of DINOv2 or of timm."""

    def __init__(self, weights: Weights, is_antialiased: bool = False) -> None:
        self.weights = weights
        self.is_antialiased = is_antialiased
        # Metric3D stores all blocks in one chunk.
        self._block = "blocks.0.{}." if "blocks.0.0.norm1.weight" in weights else "blocks.{}."
        self.width = weights["patch_embed.proj.weight"].shape[0]
        wanted = f"a ViT of width {', '.join(map(str, _BLOCKS))} (S, B, L) in {weights.file}"
        found = f"one of width {self.width}; give another size of the network"
        require(self.width in _BLOCKS, wanted, found)
        self.depth = _BLOCKS[self.width]
        class_token, positions = weights["cls_token"], weights["pos_embed"]
        if positions.shape[1] == _TRAINED_GRID**2 + 1:
            # DINOv2 keeps the class token's position in row 0; timm has already added it.
            class_token, positions = class_token + positions[:, :1], positions[:, 1:]
        registers = [weights[n] for n in ("register_tokens", "reg_token") if n in weights]
        self._leading = torch.cat([class_token, *registers], 1)
        self._positions = positions.unflatten(1, (_TRAINED_GRID, _TRAINED_GRID)).movedim(-1, 1)

    def __call__(
        self,
        image: Tensor,  # (B, 3, H, W) normalised, H and W multiples of 14
        taps: tuple[int, ...] = (),  # blocks to read, counted from 0, in ascending order
    ) -> list[Tokens]:
        """Return the normed tokens after the given blocks, or after the last one."""
        taps, count = taps or (self.depth - 1,), self._leading.shape[1]
        with self.weights.autocast():
            patches = self.weights.conv("patch_embed.proj", image, stride=PATCH, padding=0)
            rows, cols = patches.shape[-2:]
            patches = patches + self._resized_positions(rows, cols)
            leading = self._leading.expand(len(image), -1, -1)
            x = torch.cat([leading, patches.flatten(2).mT], 1)
            readings = []
            for index in range(self.depth):
                x = _transformer_block(self.weights.below(self._block.format(index)), x)
                if index in taps:
                    normed = self.weights.layer_norm("norm", x, _EPSILON).float()
                    grid = normed[:, count:].mT.unflatten(2, (rows, cols))
                    readings.append(Tokens(normed[:, :count], grid))
        return readings

    def _resized_positions(self, rows: int, cols: int) -> Tensor:
        """Return the positions (1, C, rows, cols)."""
        table = self._positions
        if rows == cols == _TRAINED_GRID:
            return table
        if self.is_antialiased:
            return functional.interpolate(table, (rows, cols), mode="bicubic", antialias=True)
        factors = tuple((n + _OFFSET) / _TRAINED_GRID for n in (rows, cols))
        return functional.interpolate(table, scale_factor=factors, mode="bicubic")


def _transformer_block(weights: Weights, x: Tensor) -> Tensor:
    """Apply one block to tokens (B, N, C)."""
    # Every token reads from all: softmax(q k^T / sqrt(64)) v, per head of 64 channels.
    qkv = weights.linear("attn.qkv", weights.layer_norm("norm1", x, _EPSILON))
    q, k, v = qkv.unflatten(-1, (3, -1, _HEAD_WIDTH)).permute(2, 0, 3, 1, 4)  # (B, heads, N, 64)
    read = functional.scaled_dot_product_attention(q, k, v)
    x = x + weights["ls1.gamma"] * weights.linear("attn.proj", read.transpose(1, 2).flatten(2))
    hidden = weights.linear("mlp.fc1", weights.layer_norm("norm2", x, _EPSILON))
    return x + weights["ls2.gamma"] * weights.linear("mlp.fc2", functional.gelu(hidden))


def normalise(image: Tensor) -> Tensor:  # (H, W, 3) RGB in [0, 1] -> (1, 3, H, W)
    """Return an image as these networks expect it: batch and channels first, ImageNet's scale."""
    mean, std = image.new_tensor(_IMAGENET_MEAN), image.new_tensor(_IMAGENET_STD)
    return ((image - mean) / std).permute(2, 0, 1)[None]


class DinoFeatures:
    """The patch tokens of the last block, after the final norm: a `FeatureExtractor`."""

    stride = PATCH

    def __init__(self, weights: Weights) -> None:
        self.device = weights.device
        self._transformer = VisionTransformer(weights, is_antialiased(weights))
        self.dimension = self._transformer.width

    @torch.no_grad()
    def __call__(self, frame: Frame) -> Tensor:  # (H // 14, W // 14, C) float32
        """Return one feature per patch of 14 px; the image is stretched to whole patches."""
        image = frame.image
        whole_patches = [side // PATCH * PATCH for side in image.shape[:2]]
        seen = normalise(image.to(self.device))
        stretched = functional.interpolate(seen, whole_patches, mode="bilinear")
        return self._transformer(stretched)[0].patches[0].permute(1, 2, 0).to(image.device)


def is_antialiased(weights: Weights) -> bool:
    """Tell whether a features checkpoint was trained with antialiased positions.

    The three published kinds differ in what they contain: FiT3D alone lacks the mask token, and
    DINOv2 has registers or not. A file that has lost such a tensor is known by its official name.
    """
    name = Path(weights.file).name
    is_fit3d = "mask_token" not in weights
    has_registers = "register_tokens" in weights or "reg_token" in weights
    lacks_mask = is_fit3d and ("dinov2_vit" in name or "register_tokens" in weights)
    is_whole = not lacks_mask and ("_reg" not in name or has_registers)
    lost = "mask_token" if lacks_mask else "register tokens"
    require(is_whole, f"{lost} in {weights.file}", "none; the file is not complete")
    return is_fit3d or has_registers
