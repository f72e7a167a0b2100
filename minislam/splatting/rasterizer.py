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
    ellipse_vjp,
    exponents,
    exponents_vjp,
)
from minislam.splatting.covariance import covariance_factors, covariance_factors_vjp
from minislam.splatting.gaussians import GaussianMap
from minislam.splatting.projection import (
    conics_from_footprints,
    conics_from_footprints_vjp,
    project_factors,
    project_factors_vjp,
    project_means,
    project_means_vjp,
    to_camera,
    to_camera_twist_vjp,
    to_camera_vjp,
)
from minislam.splatting.rendering import (
    LOW_PASS_VARIANCE,
    MAX_OPACITY,
    MIN_ALPHA,
    NEAR_DEPTH,
    Rendering,
    tangent_limits,
)
from minislam.splatting.tiles import PIXELS, TILE, TileGroup, TileLists, build_tile_lists, tile_grid

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
    if background is None:
        background = torch.zeros(3)
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
            torch.cat([background.detach(), torch.zeros(1)]).to(like),  # at depth 0: adds nothing
            camera,
        )
    )


class _Projected(NamedTuple):
    """The visible Gaussians, nearest first, in every form that the backward needs."""

    index: Tensor  # (V,) int64, row in the map
    quats: Tensor  # (4, V)
    scales: Tensor  # (3, V)
    opacities: Tensor  # (V,) at most MAX_OPACITY
    points_camera: Tensor  # (3, V)
    camera_factors: Tensor  # (3, 3, V)
    footprints: Tensor  # (2, 3, V)
    means2d: Tensor  # (2, V)
    conics: Tensor  # (3, V)
    covariances2d: Tensor  # (3, V)


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
        ctx, means, quats, scales, opacities, colors, twist, offsets2d, T, background, camera
    ):
        if twist is not None and twist.any():
            T = se3_exp(twist).to(T) @ T
        with _denormals_flushed():
            projected = _project(means, quats, scales, opacities, offsets2d, T, camera)
            features = torch.cat(
                [colors[projected.index].T, projected.points_camera[2:]]
            ).contiguous()
            composited, image, contribution = _composite(projected, features, background, camera)
        ctx.state = projected, composited, T, background, camera, len(means), twist
        per_gaussian = means.new_zeros(2, len(means))
        per_gaussian[0, projected.index] = _radii(projected, composited.lists)
        per_gaussian[1, projected.index] = contribution
        color = image[:3].permute(1, 2, 0).contiguous()
        outputs = color, image[3].clone(), image[4].clone(), per_gaussian[0], per_gaussian[1]
        ctx.mark_non_differentiable(*outputs[3:])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, v_color, v_depth, v_opacity, _v_radii, _v_contribution):
        projected, composited, T, background, camera, count, twist = ctx.state
        v_image = torch.cat([v_color.permute(2, 0, 1), v_depth[None], v_opacity[None]])
        with _denormals_flushed():
            v_slots = _composite_vjp(composited, background, v_image, camera)
            visible = len(projected.index)
            v_gaussians = v_slots.new_zeros(len(v_slots), visible + 1)
            v_gaussians.index_add_(1, composited.lists.slot_gaussian, v_slots)
            return _project_vjp(ctx, projected, v_gaussians[:, :visible], T, camera, count, twist)


def _project(
    means: Tensor,  # (N, 3)
    quats: Tensor,  # (N, 4)
    scales: Tensor,  # (N, 3)
    opacities: Tensor,  # (N,)
    screen_offsets: Tensor | None,  # (N, 2)
    T_camera_world: Tensor,  # (4, 4)
    camera: Camera,
) -> _Projected:
    """Sort out what cannot be seen, and project the rest in order of depth."""
    index = _visible_front_to_back(means, scales, opacities, T_camera_world, camera)
    means, quats, scales = (rows[index].T.contiguous() for rows in (means, quats, scales))
    # Capped per Gaussian, not per pixel: the profile stays smooth, and alpha <= o is safe as well.
    opacities = opacities[index].clamp(max=MAX_OPACITY)
    points_camera, camera_factors = to_camera(
        means, covariance_factors(quats, scales), T_camera_world
    )
    means2d = project_means(points_camera, camera)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[index].T
    footprints = project_factors(points_camera, camera_factors, camera)
    conics, covariances2d = conics_from_footprints(footprints)
    return _Projected(
        index, quats, scales, opacities, points_camera, camera_factors,
        footprints, means2d, conics, covariances2d,
    )  # fmt: skip


def _visible_front_to_back(
    means: Tensor, scales: Tensor, opacities: Tensor, T_camera_world: Tensor, camera: Camera
) -> Tensor:  # (V,) int64
    """Return the rows that may be seen, nearest first; equal depths stay in map order.

    The radius is bounded before anything is projected: |J| <= f/z sqrt(1 + |h|^2), and the
    largest support of a Gaussian is sqrt(2 ln(MAX_OPACITY / MIN_ALPHA)) = 3.33 deviations.
    """
    x, y, z = torch.addmm(T_camera_world[:3, 3:], T_camera_world[:3, :3], means.T)
    in_front = z > NEAR_DEPTH
    z_safe = torch.where(in_front, z, 1)  # what is dropped must not divide by zero
    tangents = x / z_safe, y / z_safe
    limits = torch.tensor(tangent_limits(camera)).abs().amax(0)
    largest_scale = torch.maximum(torch.maximum(scales[:, 0], scales[:, 1]), scales[:, 2])
    stretch = max(camera.fx, camera.fy) * (1 + float(limits.square().sum())) ** 0.5
    radius = largest_scale * stretch / z_safe
    level = 2 * torch.tensor(MAX_OPACITY / MIN_ALPHA).log().item() + 1e-3
    radius = ((radius * radius + LOW_PASS_VARIANCE) * level).sqrt()
    u, v = camera.fx * tangents[0] + camera.cx, camera.fy * tangents[1] + camera.cy
    near_u = (u + radius >= 0) & (u - radius <= camera.width - 1)
    near_v = (v + radius >= 0) & (v - radius <= camera.height - 1)
    index = (in_front & near_u & near_v & (opacities > MIN_ALPHA)).nonzero()[:, 0]
    return index[z[index].argsort(stable=True)]


def _project_vjp(
    ctx,
    projected: _Projected,
    v_gaussians: Tensor,  # (10, V): moments (6), features (4)
    T_camera_world: Tensor,
    camera: Camera,
    count: int,  # N
    twist: Tensor | None,
) -> tuple[Tensor | None, ...]:
    """Pull the slots' summed gradients back to the inputs of the Function, where needed."""
    needs_means, needs_quats, needs_scales, needs_opacities, needs_colors = ctx.needs_input_grad[:5]
    needs_twist, needs_offsets = ctx.needs_input_grad[5:7]
    p = projected
    v_log_opacities, v_means2d, v_conics = ellipse_vjp(p.conics, v_gaussians[:6])

    v_footprints = conics_from_footprints_vjp(p.footprints, p.conics, v_conics)
    v_points, v_camera_factors = project_factors_vjp(
        p.points_camera, p.camera_factors, p.footprints, camera, v_footprints
    )
    v_points += project_means_vjp(p.points_camera, camera, v_means2d)
    v_points[2] += v_gaussians[9]  # the depth image shows z itself

    def rows(values: Tensor) -> Tensor:
        full = values.new_zeros(count, *values.shape[:-1])
        full[p.index] = values.T if values.dim() == 2 else values
        return full

    v_means = v_quats = v_scales = v_opacities = v_colors = v_twist = v_offsets = None
    if needs_twist:
        v_left = to_camera_twist_vjp(p.points_camera, p.camera_factors, v_points, v_camera_factors)
        # exp(twist + d) = exp(J d) exp(twist), and J is the identity at twist = 0.
        v_twist = se3_left_jacobian(twist).T.to(v_left) @ v_left if twist.any() else v_left
        v_twist = v_twist.to(twist)
    if needs_means or needs_quats or needs_scales:
        v_world, v_factors = to_camera_vjp(T_camera_world, v_points, v_camera_factors)
        v_means = rows(v_world)
    if needs_quats or needs_scales:
        v_unit, v_axes = covariance_factors_vjp(p.quats, p.scales, v_factors)
        v_quats, v_scales = rows(v_unit), rows(v_axes)
    if needs_opacities:
        below_cap = p.opacities < MAX_OPACITY
        v_opacities = rows(v_log_opacities / p.opacities * below_cap)
    if needs_colors:
        v_colors = rows(v_gaussians[6:9])
    if needs_offsets:
        v_offsets = rows(v_means2d)
    gradients = v_means, v_quats, v_scales, v_opacities, v_colors, v_twist, v_offsets
    return *gradients, None, None, None


def _composite(
    projected: _Projected,
    features: Tensor,  # (4, V)
    background: Tensor,  # (4,)
    camera: Camera,
) -> tuple[_Composited, Tensor, Tensor]:  # ..., (5, H, W), (V,)
    """Composite all tiles; return colour, depth and opacity, and the weight of each Gaussian."""
    p = projected
    lists = build_tile_lists(p.means2d, p.conics, p.covariances2d, p.opacities, camera)
    padding = features.new_zeros(10, 1)
    padding[5] = _LOG_OPACITY_OF_PADDING
    table = torch.cat([p.means2d, p.conics, p.opacities.log()[None], features])
    slots = torch.cat([table, padding], 1).index_select(1, lists.slot_gaussian)
    offsets = slots[:2] - _tile_centres(camera, features)[:, lists.slot_tile]
    coefficients = exponents(offsets, slots[2:5], slots[5])

    inside = _to_tiles(features.new_ones(1, camera.height, camera.width), camera)[:, 0]
    canvas = features.new_zeros(len(inside), 5, PIXELS)
    canvas[:, :4] = background[:, None]
    contribution = features.new_zeros(len(p.index) + 1)
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
    return composited, _from_tiles(canvas, camera), contribution[:-1]


def _composite_vjp(
    composited: _Composited,
    background: Tensor,  # (4,)
    v_image: Tensor,  # (5, H, W)  dL/d(color, depth, opacity)
    camera: Camera,
) -> Tensor:  # (10, S)
    """Pull image gradients back to the slots: six moments about the mean, four features."""
    c = composited
    v_canvas = _to_tiles(v_image, camera)
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


def _radii(projected: _Projected, lists: TileLists) -> Tensor:  # (V,) px
    """Return three standard deviations along the longer axis, 0 for what is in no tile."""
    xx, xy, yy = projected.covariances2d
    largest = (xx + yy) / 2 + torch.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    listed = torch.bincount(lists.slot_gaussian, minlength=len(xx) + 1)[: len(xx)] > 0
    return 3 * largest.sqrt() * listed


def _tile_centres(camera: Camera, like: Tensor) -> Tensor:  # (2, tiles) px
    rows, columns = tile_grid(camera)
    u = torch.arange(columns).to(like) * TILE + (TILE - 1) / 2
    v = torch.arange(rows).to(like) * TILE + (TILE - 1) / 2
    return torch.stack([u.repeat(rows), v.repeat_interleave(columns)])


def _to_tiles(image: Tensor, camera: Camera) -> Tensor:  # (C, H, W) -> (tiles, C, P)
    rows, columns = tile_grid(camera)
    pad = (0, columns * TILE - camera.width, 0, rows * TILE - camera.height)
    tiled = torch.nn.functional.pad(image, pad).view(-1, rows, TILE, columns, TILE)
    return tiled.permute(1, 3, 0, 2, 4).reshape(rows * columns, -1, PIXELS)


def _from_tiles(tiled: Tensor, camera: Camera) -> Tensor:  # (tiles, C, P) -> (C, H, W)
    rows, columns = tile_grid(camera)
    image = tiled.view(rows, columns, -1, TILE, TILE).permute(2, 0, 3, 1, 4)
    return image.reshape(-1, rows * TILE, columns * TILE)[:, : camera.height, : camera.width]


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
