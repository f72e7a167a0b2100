"""Insert Gaussians for what a keyframe sees and the map does not show, without dynamic objects."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from minislam.geometry import Camera, se3_inverse, transform_points
from minislam.mapping.config import InsertionConfig
from minislam.splatting import GaussianMap, Rendering

EXPLAINED_OPACITY = 0.8  # a pixel of the map that is at least so opaque gets no new Gaussian
_SMALLEST_SCALE = 1e-8  # world units; a scale must be positive, because its logarithm is stored


def insertable_pixels(
    depth: Tensor,  # (H, W) world units, 0 where unknown
    far_limit: float,  # world units
    weight: Tensor,  # (H, W) static weight, 0 on dynamic objects
    rendering: Rendering | None,  # the map from this view, None while it is empty
) -> Tensor:  # (H, W) bool
    """Tell which pixels may add a Gaussian.

    The reference depth must be known and not too far, the static weight positive, and the map
    transparent there. Where the map shows a surface at another depth, nothing is added either. A
    nearer reference may be a dynamic object that the MLP has not learned yet. A farther one means
    that the map still holds a dynamic object, which `is_on_dynamic_object` finds, or the blurred
    edge of a static one.
    """
    wanted = (depth > 0) & (depth < far_limit) & (weight > 0)
    if rendering is not None:
        wanted &= rendering.opacity < EXPLAINED_OPACITY
    return wanted


def draw_pixels(
    known: Tensor,  # (H, W) bool
    cell: int,  # px, side of a cell
    generator: torch.Generator,
) -> Tensor:  # (M, 2) int64, column and row
    """Draw one random known pixel in each cell x cell square of the image that has any.

    The official random subset of the image leaves clumps, holes and less where depth is sparse.
    """
    height, width = known.shape
    priority = torch.rand(height, width, generator=generator).to(known.device)
    priority = torch.where(known, priority, -1)
    square = cell, cell
    highest, where = functional.max_pool2d_with_indices(priority[None], square, ceil_mode=True)
    drawn = where[highest >= 0]
    return torch.stack([drawn % width, drawn // width], -1)


def gaussians_at_pixels(
    pixels: Tensor,  # (M, 2) int64, column and row
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    depth: Tensor,  # (H, W) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64
    position: int,  # of the keyframe that the new Gaussians are anchored to
    config: InsertionConfig,
) -> GaussianMap:
    """Back-project pixels to round Gaussians that just cover their cells at that depth."""
    column, row = pixels.unbind(-1)
    z = depth[row, column]
    points_camera = camera.backproject(pixels.to(z), z)
    means = transform_points(se3_inverse(T_camera_world), points_camera.double()).to(z)
    focal = math.sqrt(camera.fx * camera.fy)
    scales = (config.footprint * config.cell * z / focal).clamp_min(_SMALLEST_SCALE)
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
    T_camera_world: Tensor,  # (4, 4) float64, of the keyframe they were inserted for
    weight: Tensor,  # (H, W) static weight of that keyframe, 0 on dynamic objects
) -> Tensor:  # (N,) bool
    """Tell which Gaussians project to pixels of static weight 0 in their own keyframe."""
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
