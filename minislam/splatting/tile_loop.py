"""The loop over the tiles of an image: from projected Gaussians to pixels, and back.

One group of tiles at a time: its arrays stay in the cache, and none is as long as all lists.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from minislam.geometry import Camera
from minislam.splatting import compositing
from minislam.splatting.tiles import PIXELS, build_tile_lists, from_tiles, tile_centres, to_tiles
from minislam.splatting.visible import VisibleGaussians

# ln of the opacity of a padding slot. Finite, because 0 * inf would be NaN in a matrix product.
_LOG_OPACITY_OF_PADDING = -1e4


class CompositedGroup(NamedTuple):
    """What the backward needs of a group of tiles."""

    tiles: Tensor  # (B,) int64
    gaussians: Tensor  # (S,) int64
    chunks: list[compositing.Chunk]
    offsets: Tensor  # (2, S) px, mean minus tile centre
    coefficients: Tensor  # (6, S)
    channels: Tensor  # (S, 4)
    checkpoints: list[Tensor]  # (b, P)


def composite_image(
    visible: VisibleGaussians,
    channels: Tensor,  # (V, 4)
    background: Tensor,  # (4,)
    camera: Camera,
) -> tuple[Tensor, Tensor, Tensor, list[CompositedGroup], compositing.Workspace]:
    """List the Gaussians of every tile and composite them.

    Returned are colour and depth (4, H, W), opacity (H, W), the blending weight (V,) [px] of each
    Gaussian summed over all pixels, and for the backward the groups and the workspace.
    """
    g = visible
    lists = build_tile_lists(g.means2d, g.conics, g.covariances2d, g.opacities, camera)
    # Padding slots take their values from an additional last row or column.
    channels = pad(channels, (0, 0, 0, 1))
    table = pad(torch.cat([g.means2d, g.conics, g.opacities.log()[None]]), (0, 1))
    table[5, -1] = _LOG_OPACITY_OF_PADDING

    centres = tile_centres(camera, channels)
    inside = to_tiles(channels.new_ones(1, camera.height, camera.width), camera)[:, 0]
    canvas = background[:, None].repeat(len(inside), 1, PIXELS)  # (tiles, 4, P)
    opacities = torch.zeros_like(inside)
    weight_sums = channels.new_zeros(len(channels))
    workspace = compositing.Workspace([c for group in lists for c in group.chunks], channels)
    groups = []
    for tiles, gaussians, chunks in lists:
        slots = table.index_select(1, gaussians)
        tile_of_slot = torch.cat([tiles[-b:].repeat(k) for k, b in chunks])
        offsets = slots[:2] - centres.index_select(1, tile_of_slot)
        coefficients = compositing.log_alpha_coefficients(offsets, slots[2:5], slots[5])
        group_channels = channels.index_select(0, gaussians)
        out = compositing.composite(
            chunks, coefficients, group_channels, background, inside[tiles], workspace
        )
        canvas[tiles] = out.channels
        opacities[tiles] = 1 - out.transmittance
        weight_sums.index_add_(0, gaussians, out.weight_sums)
        kept = tiles, gaussians, chunks, offsets, coefficients, group_channels, out.checkpoints
        groups.append(CompositedGroup(*kept))
    opacity = from_tiles(opacities, camera)[0].clone()
    return from_tiles(canvas, camera), opacity, weight_sums[:-1], groups, workspace


def composite_image_vjp(
    groups: list[CompositedGroup],
    workspace: compositing.Workspace,
    count: int,  # V
    background: Tensor,  # (4,)
    v_channels: Tensor,  # (4, H, W)
    v_opacity: Tensor,  # (H, W)
    camera: Camera,
) -> tuple[Tensor, Tensor]:  # (6, V), (4, V)
    """Pull image gradients back to the Gaussians: six moments about the mean, four channels."""
    v_canvas = to_tiles(v_channels, camera)
    v_transmittances = to_tiles(-v_opacity[None], camera)[:, 0]
    sums = v_channels.new_zeros(10, count + 1)  # the last column collects the padding
    for group in groups:
        v_coefficients, v_group = compositing.composite_vjp(
            group.chunks, group.coefficients, group.channels, background, group.checkpoints,
            v_canvas[group.tiles], v_transmittances[group.tiles], workspace,
        )  # fmt: skip
        moments = compositing.log_alpha_coefficients_vjp(group.offsets, v_coefficients)
        sums[:6].index_add_(1, group.gaussians, moments)
        sums[6:].index_add_(1, group.gaussians, v_group.T)
    return sums[:6, :-1], sums[6:, :-1]
