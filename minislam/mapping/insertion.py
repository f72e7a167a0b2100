"""Insert Gaussians for what an image shows and the map does not, without dynamic objects."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from minislam.geometry import Camera, se3_inverse, transform_points
from minislam.mapping.config import InsertionConfig
from minislam.splatting import GaussianMap, Rendering

EXPLAINED_OPACITY = 0.8  # a pixel of the map that is at least so opaque gets no new Gaussian
WIDER = 2  # times that a cell may double where the image is plain
SURFACE = 1.1  # farthest over nearest depth within a wider cell [-]
_SMALLEST_SCALE = 1e-8  # world units; a scale must be positive, because its logarithm is stored


def insertable_pixels(
    depth: Tensor,  # (H, W) world units, 0 where unknown
    far_limit: float,  # world units
    weight: Tensor,  # (H, W) static weight, 0 on dynamic objects
    rendering: Rendering | None,  # the map from this view, None while it is empty
) -> Tensor:  # (H, W) bool
    """Tell which pixels of known, not too far depth may add a Gaussian: the map shows none there.

    Nothing is added either where the map shows a surface at another depth. A nearer reference may
    be a dynamic object that the MLP has not learned yet. A farther one means that the map still
    holds a dynamic object, which `is_on_dynamic_object` finds, or the blurred edge of a static one.
    """
    wanted = (depth > 0) & (depth < far_limit) & (weight > 0)
    if rendering is not None:
        wanted &= rendering.opacity < EXPLAINED_OPACITY
    return wanted


def cell_sides(
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    depth: Tensor,  # (H, W) world units, 0 where unknown
    cell: int,  # px, side of the smallest cells
    plain: float,  # largest range of each colour, in [0, 1], in a wider cell
) -> Tensor:  # (H, W) int64 px
    """Return the side of the cell of each pixel: wide where one Gaussian can stand for many."""
    # A cell of twice or four times the side shows one surface and hardly any detail: its depths are
    # about the same, and so are its colours once noise is gone, by the mean of 3 x 3 pixels.
    height, width = depth.shape
    smooth = functional.avg_pool2d(image.permute(2, 0, 1), 3, 1, 1, count_include_pad=False)
    seen = torch.cat([smooth, depth[None].to(smooth)])
    sides = torch.full_like(depth, cell, dtype=torch.int64)
    for side in (cell << level for level in range(1, WIDER + 1)):
        highest, lowest = (
            sign * functional.max_pool2d(sign * seen, side, ceil_mode=True) for sign in (1, -1)
        )
        is_plain = (highest - lowest)[:3].amax(0) < plain
        is_wide = is_plain & (highest[3] < SURFACE * lowest[3])
        is_wide = is_wide.repeat_interleave(side, 0).repeat_interleave(side, 1)
        sides[is_wide[:height, :width]] = side
    return sides


def draw_pixels(
    known: Tensor,  # (H, W) bool
    sides: Tensor,  # (H, W) int64 px, of the cells
    generator: torch.Generator,
) -> Tensor:  # (M, 2) int64, column and row
    """Draw one random known pixel in each cell of the image that has any."""
    # The official random subset of the image leaves clumps, holes and less where depth is sparse.
    height, width = known.shape
    priority = torch.rand(height, width, generator=generator).to(known.device)
    drawn = []
    for side in sides.flatten().bincount().nonzero()[:, 0].tolist():
        here = torch.where(known & (sides == side), priority, -1)[None]
        highest, where = functional.max_pool2d_with_indices(here, (side, side), ceil_mode=True)
        drawn.append(where[highest >= 0])
    pixels = torch.cat(drawn)
    return torch.stack([pixels % width, pixels // width], -1)


def gaussians_at_pixels(
    pixels: Tensor,  # (M, 2) int64, column and row
    sides: Tensor,  # (H, W) px, of the cells
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    depth: Tensor,  # (H, W) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64
    position: int,  # of the image that the new Gaussians are anchored to
    config: InsertionConfig,
) -> GaussianMap:
    """Back-project pixels to round Gaussians that just cover their cells at that depth."""
    column, row = pixels.unbind(-1)
    z = depth[row, column]
    points_camera = camera.backproject(pixels.to(z), z)
    means = transform_points(se3_inverse(T_camera_world), points_camera.double()).to(z)
    focal = math.sqrt(camera.fx * camera.fy)
    scales = (config.footprint * sides[row, column] * z / focal).clamp_min(_SMALLEST_SCALE)
    count = len(z)
    logit = math.log(config.opacity / (1 - config.opacity))
    return GaussianMap(
        means,
        z.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales.log()[:, None].expand(count, 3).clone(),
        torch.full_like(z, logit),
        image[row, column].to(z),
        torch.full((count,), position, dtype=torch.int64, device=z.device),
    )


def is_on_dynamic_object(
    means: Tensor,  # (N, 3) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64, of the image they were inserted for
    weight: Tensor,  # (H, W) static weight of that image, 0 on dynamic objects
) -> Tensor:  # (N,) bool
    """Tell which Gaussians project to pixels of static weight 0 in their own image."""
    # Optimisation may have moved a Gaussian out of the image: the nearest pixel counts.
    z, row, column, _ = nearest_pixels(means, camera, T_camera_world)
    return (z > 0) & (weight[row, column] == 0)


def nearest_pixels(
    means: Tensor,  # (N, 3) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # z float64, row and column int64, inside bool: (N,)
    """Return depth and nearest pixel of points, and which are in front of the camera and inside."""
    points = transform_points(T_camera_world, means.double())
    z = points[:, 2]
    # A point behind the camera has no pixel; another point takes its place.
    pixels = camera.project(torch.where((z > 0)[:, None], points, torch.ones_like(points)))
    column = pixels[:, 0].round().clamp(0, camera.width - 1).long()
    row = pixels[:, 1].round().clamp(0, camera.height - 1).long()
    return z, row, column, (z > 0) & camera.contains(pixels)
