"""All tiles of an image: from ellipses to pixels, and back.

Every step works on one group of tiles at a time: what it makes is still in the cache when the
next step reads it, and no array is as long as all lists together.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting.compositing import (
    Workspace,
    composite,
    composite_vjp,
    exponents,
    exponents_vjp,
)
from minislam.splatting.ellipses import Ellipses
from minislam.splatting.tiles import PIXELS, build_tile_lists, from_tiles, tile_centres, to_tiles

# ln of the opacity of a padding slot. Finite, because 0 * inf would be NaN in a matrix product.
_LOG_OPACITY_OF_PADDING = -1e4


class CompositedGroup(NamedTuple):
    """A group of tiles, with what the backward needs to walk along its slots again."""

    tiles: Tensor  # (B,) int64
    gaussians: Tensor  # (K * B,) int64
    offsets: Tensor  # (2, K * B) px, mean minus tile centre
    coefficients: Tensor  # (6, K * B)
    features: Tensor  # (K, B, 4)
    checkpoints: Tensor  # (chunks, B, P)


class CompositedImage(NamedTuple):
    """What all tiles show."""

    features: Tensor  # (4, H, W) colour and depth
    opacity: Tensor  # (H, W)
    contribution: Tensor  # (V,) px, sum of a Gaussian's weight over all pixels
    groups: list[CompositedGroup]
    workspace: Workspace  # for the backward: no second one, fewer pages taken and given back


def composite_image(
    ellipses: Ellipses,
    features: Tensor,  # (V, 4)
    background: Tensor,  # (4,)
    camera: Camera,
) -> CompositedImage:
    """List the Gaussians of every tile and composite them."""
    e = ellipses
    lists = build_tile_lists(e.means2d, e.conics, e.covariances2d, e.opacities, camera)
    # The last row or column of what the slots are filled from is the padding.
    features = torch.cat([features, features.new_zeros(1, 4)])
    padding = features.new_zeros(6, 1)
    padding[5] = _LOG_OPACITY_OF_PADDING
    table = torch.cat([e.means2d, e.conics, e.opacities.log()[None]])
    table = torch.cat([table, padding], 1)

    centres = tile_centres(camera, features)
    inside = to_tiles(features.new_ones(1, camera.height, camera.width), camera)[:, 0]
    canvas = background[:, None].repeat(len(inside), 1, PIXELS)  # (tiles, 4, P)
    opacities = torch.zeros_like(inside)
    contribution = features.new_zeros(len(features))
    workspace = Workspace(lists.largest_group, features)
    groups = []
    for tiles, length, span in lists.groups:
        gaussians = lists.slot_gaussian[span]
        slots = table.index_select(1, gaussians)
        offsets = slots[:2].view(2, length, -1) - centres[:, None, tiles]
        offsets = offsets.view(2, -1)
        coefficients = exponents(offsets, slots[2:5], slots[5])
        group_features = features.index_select(0, gaussians).view(length, -1, 4)
        out = composite(coefficients, group_features, background, inside[tiles], workspace)
        canvas[tiles] = out.features
        opacities[tiles] = 1 - out.transmittance
        contribution.index_add_(0, gaussians, out.contribution.view(-1))
        groups.append(
            CompositedGroup(
                tiles, gaussians, offsets, coefficients, group_features, out.checkpoints
            )
        )
    opacity = from_tiles(opacities, camera)[0].clone()
    shown = from_tiles(canvas, camera)
    return CompositedImage(shown, opacity, contribution[:-1], groups, workspace)


def composite_image_vjp(
    groups: list[CompositedGroup],
    workspace: Workspace,
    count: int,  # V
    background: Tensor,  # (4,)
    v_features: Tensor,  # (4, H, W)
    v_opacity: Tensor,  # (H, W)
    camera: Camera,
) -> tuple[Tensor, Tensor]:  # (6, V), (4, V)
    """Pull image gradients back to the Gaussians: six moments about the mean, four features."""
    v_canvas = to_tiles(v_features, camera)
    v_transmittances = to_tiles(-v_opacity[None], camera)[:, 0]
    sums = v_features.new_zeros(10, count + 1)  # the last column collects the padding
    for group in groups:
        v_coefficients, v_group = composite_vjp(
            group.coefficients, group.features, background, group.checkpoints,
            v_canvas[group.tiles], v_transmittances[group.tiles], workspace,
        )  # fmt: skip
        moments = exponents_vjp(group.offsets, v_coefficients)
        sums[:6].index_add_(1, group.gaussians, moments)
        sums[6:].index_add_(1, group.gaussians, v_group.view(-1, 4).T)
    return sums[:6, :-1], sums[6:, :-1]
