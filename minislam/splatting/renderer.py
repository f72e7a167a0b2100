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
from torch.nn.functional import pad

from minislam.errors import require
from minislam.geometry import Camera, se3_exp, se3_left_jacobian
from minislam.splatting import compositing
from minislam.splatting.constants import Rendering
from minislam.splatting.gaussians import GaussianMap
from minislam.splatting.tiles import PIXELS, build_tile_lists, from_tiles, tile_centres, to_tiles
from minislam.splatting.visible import VisibleGaussians, project_gaussians, project_gaussians_vjp

# ln of the opacity of a padding slot. Finite, because 0 * inf would be NaN in a matrix product.
_LOG_OPACITY_OF_PADDING = -1e4


def render(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4), gets no gradient: see `twist`
    background: Tensor | None = None,  # (3,) RGB, gets no gradient; None is black
    twist: Tensor | None = None,  # (6,) left perturbation of the pose: T <- exp(twist) T
    screen_offsets: Tensor | None = None,  # (N, 2) px, added to the projected means
) -> Rendering:
    """Render colour, depth and opacity of a map from a camera pose.

    Gradients reach the inputs that require them. To refine a pose, give a `twist` of zeros and
    detach the map: nothing is then computed for the Gaussians. For densification, give
    `screen_offsets` of zeros: the rows of its gradient are those of the projected means in pixels.
    Slow twin: reference.render_reference. Eq. (2).
    """
    found = f"{tuple(T_camera_world.shape)}; give T_camera_world of one view"
    require(T_camera_world.shape == (4, 4), "a camera pose of shape (4, 4)", found)
    like = gaussians.means
    channels_behind = like.new_zeros(4)  # of the background: at depth 0, which adds nothing
    if background is not None:
        channels_behind[:3] = background.detach()
    rows = like, gaussians.quats_wxyz, gaussians.scales, gaussians.opacities, gaussians.colors
    view = T_camera_world.detach().to(like), channels_behind, camera
    return Rendering(*_Render.apply(*rows, twist, screen_offsets, *view))


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
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if twist is not None and twist.any():
            T = se3_exp(twist).to(T) @ T
        with _denormals_flushed():
            visible = project_gaussians(means, quats, scales, opacities, offsets2d, T, camera)
            channels = colors.index_select(0, visible.rows)
            channels = torch.cat([channels, visible.points_camera[2:].T], 1)
            image, opacity, sums, *kept = composite_image(visible, channels, background, camera)
        weight_sums = means.new_zeros(len(means))
        weight_sums[visible.rows] = sums
        ctx.state = visible, *kept, T, background, camera, len(means), twist
        ctx.mark_non_differentiable(weight_sums)
        return image[:3].permute(1, 2, 0).contiguous(), image[3].clone(), opacity, weight_sums

    @staticmethod
    @once_differentiable
    def backward(
        ctx,
        v_color: Tensor,  # (H, W, 3)
        v_depth: Tensor,  # (H, W)
        v_opacity: Tensor,  # (H, W)
        _v_weight_sums: Tensor,
    ) -> tuple[Tensor | None, ...]:
        visible, groups, workspace, T, background, camera, count, twist = ctx.state
        needs = ctx.needs_input_grad  # in the order of the inputs of `forward`
        v_image = torch.cat([v_color.permute(2, 0, 1), v_depth[None]])
        with _denormals_flushed():
            moments, v_channels = composite_image_vjp(
                groups, workspace, len(visible.rows), background, v_image, v_opacity, camera
            )
            needs_shape = needs[1] or needs[2]
            v = project_gaussians_vjp(visible, moments, v_channels[3], T, camera, needs_shape)

        def spread(values: Tensor) -> Tensor:
            """Write (C, V) or (V,) to the rows of the map; invisible rows are zero."""
            values = values.T if values.dim() == 2 else values
            return values.new_zeros(count, *values.shape[1:]).index_copy_(0, visible.rows, values)

        by_gaussian = v.means, v.quats, v.scales, v.opacities, v_channels[:3], v.means2d
        *v_parameters, v_offsets2d = (
            spread(values) if needed and values is not None else None
            for values, needed in zip(by_gaussian, (*needs[:5], needs[6]), strict=True)
        )
        v_twist = v.twist.to(twist) if needs[5] else None
        if v_twist is not None and twist.any():  # J of exp(twist + d) = exp(J d) exp(twist), else I
            v_twist = se3_left_jacobian(twist).T @ v_twist
        return *v_parameters, v_twist, v_offsets2d, None, None, None


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
    # One group at a time: its arrays stay in the cache, and none is as long as all lists.
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


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Treat denormal numbers as zero in this thread, and restore what was set before."""
    # Behind twenty nearly opaque Gaussians T is denormal, and each product takes a hundred cycles.
    smallest_normal = torch.finfo(torch.float32).tiny
    already = float(torch.full((1,), smallest_normal, device="cpu") * 0.5) == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(already)
