"""The renderer: projection, tile lists and compositing, forward and backward (Sec. 3.1).

`render` is one torch.autograd.Function. Its backward calls the hand-written `_vjp` of every step
in reverse; torch differentiates nothing inside. The same code runs on any device and dtype.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from minislam.errors import InputError
from minislam.geometry import Camera, se3_exp, se3_left_jacobian
from minislam.splatting.compositing import (
    Workspace,
    composite,
    composite_vjp,
    exponents,
    exponents_vjp,
)
from minislam.splatting.ellipses import Ellipses, project_gaussians, project_gaussians_vjp
from minislam.splatting.gaussians import GaussianMap
from minislam.splatting.rendering import Rendering
from minislam.splatting.tiles import (
    PIXELS,
    TileGroup,
    TileLists,
    build_tile_lists,
    from_tiles,
    tile_centres,
    to_tiles,
)

# ln of the opacity of a padding slot. Finite, because 0 * inf would be NaN in a matrix product.
_LOG_OPACITY_OF_PADDING = -1e4


def render(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4), carries no gradient: see `twist`
    background: Tensor | None = None,  # (3,) RGB, carries no gradient; None is black
    twist: Tensor | None = None,  # (6,) left perturbation of the pose: T <- exp(twist) T
    screen_offsets: Tensor | None = None,  # (N, 2) px, added to the projected means
) -> Rendering:
    """Render colour, depth and opacity of a map from a camera pose. Eq. (2).

    Gradients reach whichever inputs ask for them. For tracking, give `twist` as zeros that
    require a gradient and detach the map: nothing is then computed for the Gaussians. For
    densification, give `screen_offsets` as zeros that require a gradient: after the backward
    pass its rows are the gradients of the projected means in pixels.
    """
    if T_camera_world.shape != (4, 4):
        raise InputError(
            f"expected a camera pose of shape (4, 4), found {tuple(T_camera_world.shape)}; "
            "give T_camera_world of one view"
        )
    like = gaussians.means
    features_behind = like.new_zeros(4)  # of the background: at depth 0, which adds nothing
    if background is not None:
        features_behind[:3] = background.detach()
    return Rendering(
        *_Render.apply(
            like,
            gaussians.quats_wxyz,
            gaussians.scales,
            gaussians.opacities,
            gaussians.colors,
            twist,
            screen_offsets,
            T_camera_world.detach().to(like),
            features_behind,
            camera,
        )
    )


class _Composited(NamedTuple):
    """The slots of all tile groups, and what the backward needs to walk along them again."""

    lists: TileLists
    offsets: Tensor  # (2, S) px, mean minus tile centre
    coefficients: Tensor  # (6, S)
    features: list[Tensor]  # per group (B, K, 4)
    checkpoints: list[Tensor]  # per group (chunks, B, P)


class _Render(torch.autograd.Function):
    """The chain of all steps. Activated parameters in, image out."""

    @staticmethod
    def forward(
        ctx,
        means: Tensor,  # (N, 3)
        quats: Tensor,  # (N, 4) wxyz, raw
        scales: Tensor,  # (N, 3)
        opacities: Tensor,  # (N,)
        colors: Tensor,  # (N, 3)
        twist: Tensor | None,  # (6,)
        offsets2d: Tensor | None,  # (N, 2) px
        T: Tensor,  # (4, 4) camera_world
        background: Tensor,  # (4,) RGB and depth
        camera: Camera,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        if twist is not None and twist.any():
            T = se3_exp(twist).to(T) @ T
        with _denormals_flushed():
            ellipses = project_gaussians(means, quats, scales, opacities, offsets2d, T, camera)
            features = torch.cat([colors[ellipses.index].T, ellipses.points_camera[2:]])
            composited, image, contribution = _composite(ellipses, features, background, camera)
        per_gaussian = means.new_zeros(2, len(means))
        per_gaussian[0, ellipses.index] = ellipses.radii * (contribution > 0)
        per_gaussian[1, ellipses.index] = contribution
        color = image[:3].permute(1, 2, 0).contiguous()
        outputs = color, image[3].clone(), image[4].clone(), per_gaussian[0], per_gaussian[1]
        ctx.state = ellipses, composited, T, background, camera, len(means), twist
        ctx.mark_non_differentiable(*outputs[3:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(
        ctx,
        v_color: Tensor,  # (H, W, 3)
        v_depth: Tensor,  # (H, W)
        v_opacity: Tensor,  # (H, W)
        _v_radii: Tensor,
        _v_contribution: Tensor,
    ) -> tuple[Tensor | None, ...]:
        ellipses, composited, T, background, camera, count, twist = ctx.state
        needs_means, needs_quats, needs_scales, needs_opacities, needs_colors = (
            ctx.needs_input_grad[:5]
        )
        needs_twist, needs_offsets2d = ctx.needs_input_grad[5:7]
        v_image = torch.cat([v_color.permute(2, 0, 1), v_depth[None], v_opacity[None]])
        visible = len(ellipses.index)
        with _denormals_flushed():
            v_slots = _composite_vjp(composited, background, v_image, camera)
            sums = v_slots.new_zeros(10, visible + 1)  # the last column collects the padding
            sums.index_add_(1, composited.lists.slot_gaussian, v_slots)
            moments, v_colors, v_depths = sums[:6, :visible], sums[6:9, :visible], sums[9, :visible]
            v = project_gaussians_vjp(
                ellipses, moments, v_depths, T, camera, needs_quats or needs_scales
            )

        def rows(values: Tensor, needed: bool) -> Tensor | None:
            """Spread (C, V) or (V,) over the rows of the map, zero where nothing is visible."""
            if not needed:
                return None
            full = values.new_zeros(count, *values.shape[:-1])
            full[ellipses.index] = values.T if values.dim() == 2 else values
            return full

        return (
            rows(v.means, needs_means),
            rows(v.quats, needs_quats),
            rows(v.scales, needs_scales),
            rows(v.opacities, needs_opacities),
            rows(v_colors, needs_colors),
            _at_twist(v.twist, twist) if needs_twist else None,
            rows(v.means2d, needs_offsets2d),
            None,
            None,
            None,
        )


def _at_twist(v_left: Tensor, twist: Tensor) -> Tensor:  # (6,), (6,) -> (6,)
    """Turn the gradient of a left update of exp(twist) T into that of the twist itself.

    exp(twist + d) = exp(J d) exp(twist), and J is the identity at twist = 0, the usual case.
    """
    if twist.any():
        v_left = se3_left_jacobian(twist).T.to(v_left) @ v_left
    return v_left.to(twist)


def _composite(
    ellipses: Ellipses,
    features: Tensor,  # (4, V)
    background: Tensor,  # (4,)
    camera: Camera,
) -> tuple[_Composited, Tensor, Tensor]:  # ..., (5, H, W), (V,)
    """Composite all tiles; return colour, depth and opacity, and the weight of each Gaussian."""
    e = ellipses
    lists = build_tile_lists(e.means2d, e.conics, e.covariances2d, e.opacities, camera)
    padding = features.new_zeros(10, 1)
    padding[5] = _LOG_OPACITY_OF_PADDING
    table = torch.cat([e.means2d, e.conics, e.opacities.log()[None], features])
    slots = torch.cat([table, padding], 1).index_select(1, lists.slot_gaussian)
    offsets = slots[:2] - tile_centres(camera, features).index_select(1, lists.slot_tile)
    coefficients = exponents(offsets, slots[2:5], slots[5])

    inside = to_tiles(features.new_ones(1, camera.height, camera.width), camera)[:, 0]
    canvas = features.new_zeros(len(inside), 5, PIXELS)
    canvas[:, :4] = background[:, None]
    contribution = features.new_zeros(len(e.index) + 1)
    workspace = Workspace(lists.largest_group, features)
    group_features, checkpoints = [], []
    for group in lists.groups:
        group_features.append(_tile_major(slots[6:, group.span], group))
        out = composite(
            coefficients[:, group.span], group_features[-1], background,
            inside[group.tiles], workspace,
        )  # fmt: skip
        canvas[group.tiles, :4] = out.features
        canvas[group.tiles, 4] = 1 - out.transmittance
        contribution.index_add_(0, lists.slot_gaussian[group.span], out.contribution.view(-1))
        checkpoints.append(out.checkpoints)
    composited = _Composited(lists, offsets, coefficients, group_features, checkpoints)
    return composited, from_tiles(canvas, camera), contribution[:-1]


def _composite_vjp(
    composited: _Composited,
    background: Tensor,  # (4,)
    v_image: Tensor,  # (5, H, W)  dL/d(color, depth, opacity)
    camera: Camera,
) -> Tensor:  # (10, S)
    """Pull image gradients back to the slots: six moments about the mean, four features."""
    c = composited
    v_canvas = to_tiles(v_image, camera)
    v_slots = c.coefficients.new_empty(10, c.coefficients.shape[1])
    workspace = Workspace(c.lists.largest_group, v_image)
    for number, group in enumerate(c.lists.groups):
        v_group = v_canvas[group.tiles]
        v_coefficients, v_features = composite_vjp(
            c.coefficients[:, group.span], c.features[number], background, c.checkpoints[number],
            v_group[:, :4].contiguous(), -v_group[:, 4], workspace,
        )  # fmt: skip
        v_slots[:6, group.span] = exponents_vjp(c.offsets[:, group.span], v_coefficients)
        v_slots[6:, group.span] = v_features.permute(2, 1, 0).reshape(4, -1)
    return v_slots


def _tile_major(values: Tensor, group: TileGroup) -> Tensor:  # (C, K * B) -> (B, K, C)
    return values.view(len(values), group.length, -1).permute(2, 1, 0).contiguous()


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Treat denormal numbers as zero in this thread, and restore what was set before.

    Behind twenty nearly opaque Gaussians T is denormal, and each product takes a hundred cycles.
    """
    smallest_normal = torch.finfo(torch.float32).tiny
    already = float(torch.full((1,), smallest_normal) * 0.5) == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(already)
