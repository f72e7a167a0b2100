"""Tile lists: which Gaussians touch which tile, front to back."""

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from minislam.geometry import Camera
from minislam.splatting.constants import MIN_ALPHA

TILE = 8  # px, side of a tile; with 4 and 16 an image takes twice as long (time_and_memory.md)
PIXELS = TILE * TILE
# Tiles composited together, and slots of a chunk: larger blocks leave the cache, smaller ones cost
# more calls. On a GPU a call costs more than its arithmetic.
GROUP, CHUNK = 512, 12
GROUP_ON_GPU, CHUNK_ON_GPU = 4096, 64
ACTIVE = 16  # tiles of a chunk are a multiple of it: few sizes, so that blocks are used again


class Chunk(NamedTuple):
    """The next slots of a group, in its last tiles only: the lists of the others have ended."""

    slots: int
    tiles: int


class TileGroup(NamedTuple):
    """Tiles with lists of similar length, the shortest first; a slot holds one Gaussian."""

    tiles: Tensor  # (B,) int64, tile index, row by row
    # (S,) int64 place among the V visible Gaussians (V pads a list), by chunk, then slot, then tile
    gaussians: Tensor
    chunks: list[Chunk]


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Return the number of tile rows and columns that cover the image."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def tile_centres(camera: Camera, like: Tensor) -> Tensor:  # (2, tiles) px
    """Return the centre of every tile."""
    first_pixels = camera.pixel_grid(TILE, like.dtype, like.device).flatten(0, 1)
    return first_pixels.T + (TILE - 1) / 2


def to_tiles(image: Tensor, camera: Camera) -> Tensor:  # (C, H, W) -> (tiles, C, P)
    """Cut an image into tiles; pixels beyond its border are zero."""
    rows, columns = tile_grid(camera)
    beyond = (0, columns * TILE - camera.width, 0, rows * TILE - camera.height)
    tiled = pad(image, beyond).view(-1, rows, TILE, columns, TILE)
    return tiled.permute(1, 3, 0, 2, 4).reshape(rows * columns, -1, PIXELS)


def from_tiles(tiled: Tensor, camera: Camera) -> Tensor:  # (tiles, C, P) -> (C, H, W)
    """Put an image together from its tiles."""
    rows, columns = tile_grid(camera)
    image = tiled.view(rows, columns, -1, TILE, TILE).permute(2, 0, 3, 1, 4)
    return image.reshape(-1, rows * TILE, columns * TILE)[:, : camera.height, : camera.width]


def build_tile_lists(
    means2d: Tensor,  # (2, V) px, front to back
    conics: Tensor,  # (3, V) px^-2
    covariances2d: Tensor,  # (3, V) px^2
    opacities: Tensor,  # (V,) above MIN_ALPHA
    camera: Camera,
) -> list[TileGroup]:
    """List the visible Gaussians of every tile, keeping their order from front to back."""
    gaussian, tile = _entries(means2d, conics, covariances2d, opacities, camera)
    rows, columns = tile_grid(camera)
    gaussian = gaussian.index_select(0, stable_argsort(tile))
    counts = torch.bincount(tile, minlength=rows * columns)
    starts = counts.cumsum(0) - counts

    # Sorted by length: in a group, lists that end first come first, so chunks can leave them out.
    by_length = counts.argsort(stable=True)
    by_length = by_length[counts[by_length] > 0]
    gaussian_or_padding = pad(gaussian, (0, 1), value=means2d.shape[1])
    groups = []
    group, chunk = (GROUP_ON_GPU, CHUNK_ON_GPU) if tile.is_cuda else (GROUP, CHUNK)
    for tiles in by_length.split(group) if len(by_length) else ():
        lengths = counts[tiles]
        chunks = _chunks(lengths.tolist(), chunk)
        slots = sum(k for k, _ in chunks)
        position = torch.arange(slots, device=tile.device)[:, None]
        entry = torch.where(position < lengths, starts[tiles] + position, len(gaussian))
        parts = zip(entry.split(chunk), chunks, strict=True)
        listed = torch.cat([part[:, -b:].reshape(-1) for part, (_, b) in parts])
        groups.append(TileGroup(tiles, gaussian_or_padding.index_select(0, listed), chunks))
    return groups


def _chunks(lengths: list[int], slots: int) -> list[Chunk]:
    """Cut lists of ascending lengths into chunks of so many slots."""
    chunks = []
    for first in range(0, lengths[-1], slots):
        active = len(lengths) - bisect_right(lengths, first)
        active = min(len(lengths), -(-active // ACTIVE) * ACTIVE)
        chunks.append(Chunk(min(slots, lengths[-1] - first), active))
    return chunks


def _entries(
    means2d: Tensor, conics: Tensor, covariances2d: Tensor, opacities: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:  # (E,), (E,)
    """Return all pairs (Gaussian, tile) that overlap, ordered by Gaussian."""
    # alpha reaches MIN_ALPHA on the ellipse d^T Q d = level. A closed form gives its columns in a
    # row of tiles; a bounding box lists every fifth tile in vain. The small constant keeps pairs
    # that rounding may lift over the threshold.
    level = 2 * (opacities / MIN_ALPHA).log() + 1e-3
    half_height = (level * covariances2d[2]).sqrt()
    top = (means2d[1] - half_height).ceil().clamp(0, camera.height)
    bottom = (means2d[1] + half_height).floor().clamp(-1, camera.height - 1)
    # long() rounds a negative bound up, which does no harm because the count is zero there.
    first_row = (top / TILE).long()
    row_count = (bottom / TILE).long() - first_row + 1
    row_count = torch.where(top <= bottom, row_count, 0)
    gaussian, row = _expand(first_row, row_count)

    left, right = _column_spans(means2d, conics, covariances2d, level, top, bottom, gaussian, row)
    left = left.ceil().clamp(0, camera.width)
    right = right.floor().clamp(-1, camera.width - 1)
    first_column = (left / TILE).long()
    column_count = (right / TILE).long() - first_column + 1
    column_count = torch.where(left <= right, column_count, 0)
    _, columns = tile_grid(camera)
    span, tile = _expand(row * columns + first_column, column_count)
    return gaussian.index_select(0, span), tile


def _column_spans(
    means2d: Tensor,  # (2, V)
    conics: Tensor,  # (3, V)
    covariances2d: Tensor,  # (3, V)
    level: Tensor,  # (V,)
    top: Tensor,  # (V,) first and
    bottom: Tensor,  # (V,) last pixel row of the ellipse
    gaussian: Tensor,  # (R,) int64, for each (Gaussian, row of tiles)
    row: Tensor,  # (R,) int64
) -> tuple[Tensor, Tensor]:  # (R,), (R,) px
    """Return the leftmost and rightmost u that the ellipse reaches within each row of tiles.

    The ellipse is d^T Q d = level, Q = (a, b; b, c). At height y from the centre it spans
    x = -(b/a) y -+ sqrt(a level - det Q y^2) / a. Its rightmost point is at y = -b ex / c with
    ex = sqrt(level Sigma'_xx), the leftmost at -y. A y outside the row is clamped to it.
    """
    a, b, c = conics
    slope = b / a
    # det Q / a^2 = 1 / (det Sigma' a^2) = 1 / (a yy), since a = yy / det Sigma'.
    table = torch.stack([
        means2d[0], means2d[1], top, bottom, slope,
        level / a, 1 / (a * covariances2d[2]), -b / c * (level * covariances2d[0]).sqrt(),
    ])  # fmt: skip
    u, v, top, bottom, slope, reach, shrink, y_right = table.index_select(1, gaussian)
    low = torch.maximum(top, (row * TILE).to(v)) - v
    high = torch.minimum(bottom, (row * TILE + TILE - 1).to(v)) - v
    y_at_right = torch.minimum(torch.maximum(y_right, low), high)
    y_at_left = torch.minimum(torch.maximum(-y_right, low), high)
    right = u - slope * y_at_right + (reach - shrink * y_at_right**2).clamp_min(0).sqrt()
    left = u - slope * y_at_left - (reach - shrink * y_at_left**2).clamp_min(0).sqrt()
    return left, right


def _expand(first: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for each i in turn, count[i] pairs (i, value): value = first[i], first[i] + 1, ..."""
    index = torch.repeat_interleave(count)
    offset = first - (count.cumsum(0) - count)  # of the values from their places in the list
    return index, torch.arange(len(index), device=index.device) + offset.index_select(0, index)


def stable_argsort(keys: Tensor) -> Tensor:  # (N,) integers in [0, 2^31) -> (N,) int64
    """Return the stable sorting order of integers."""
    if keys.device.type != "cpu":
        return keys.argsort(stable=True)
    # numpy sorts numbers of 16 bits digit by digit, ten times as fast as longer ones.
    low, high = (half.numpy().astype(np.uint16) for half in (keys & 0xFFFF, keys >> 16))
    order = low.argsort(kind="stable")
    if high.any():
        order = order[high[order].argsort(kind="stable")]
    return torch.from_numpy(order)
