"""Insert Gaussians for what a keyframe sees and the map does not explain yet."""

import math

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_inverse, transform_points
from minislam.mapping.config import InsertionConfig
from minislam.splatting import GaussianMap, Rendering

# A first scale must be positive: its logarithm is stored.
_SMALLEST_SCALE = 1e-12  # world units


def insertable_pixels(
    depth: Tensor,  # (H, W) world units, 0 where unknown
    far_limit: float,  # world units
    weight: Tensor,  # (H, W) static weight, 0 on movers
    rendering: Rendering | None,  # the map from this view, None while it is empty
    config: InsertionConfig,
) -> Tensor:  # (H, W) bool
    """Tell which pixels may add a Gaussian.

    The reference depth must be known and not too far, the pixel static as far as the MLP knows,
    and the map must be transparent there or show another surface.
    """
    wanted = (depth > 0) & (depth < far_limit) & (weight > 0)
    if rendering is None:
        return wanted
    covered = rendering.opacity > config.explained_opacity
    # The rendered depth is a sum of weights: it is a depth only after division by the opacity.
    surface = rendering.depth / rendering.opacity.clamp_min(config.explained_opacity)
    agrees = (surface - depth).abs() < config.explained_depth * depth
    return wanted & ~(covered & agrees)


def draw_pixels(
    allowed: Tensor,  # (H, W) bool
    cell: int,  # px, side of a cell
    generator: torch.Generator,
) -> Tensor:  # (M, 2) int64, column and row
    """Draw one random pixel in each cell x cell square of the image and keep the allowed ones.

    A stratified subset: as random as the paper's, without its clumps and holes.
    """
    height, width = allowed.shape
    rows, columns = math.ceil(height / cell), math.ceil(width / cell)
    offset = torch.randint(cell, (2, rows, columns), generator=generator)
    u = torch.arange(columns) * cell + offset[0]
    v = (torch.arange(rows) * cell)[:, None] + offset[1]
    inside = (u < width) & (v < height)
    pixels = torch.stack([u[inside], v[inside]], -1).to(allowed.device)
    return pixels[allowed[pixels[:, 1], pixels[:, 0]]]


def gaussians_at_pixels(
    pixels: Tensor,  # (M, 2) int64, column and row
    image: Tensor,  # (H, W, 3) RGB in [0, 1]
    depth: Tensor,  # (H, W) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64
    keyframe_index: int,  # the new Gaussians are anchored to this keyframe
    config: InsertionConfig,
) -> GaussianMap:
    """Back-project pixels to round Gaussians that just cover their cells.

    The scale follows from the distance between neighbouring pixels of the draw, a cell, seen at
    the depth of the pixel: no search for neighbours in space is needed.
    """
    column, row = pixels.unbind(-1)
    z = depth[row, column]
    points_camera = camera.backproject(pixels.to(z), z)
    means = transform_points(se3_inverse(T_camera_world), points_camera.double()).to(z)
    focal = math.sqrt(camera.fx * camera.fy)
    scales = (config.footprint * config.cell * z / focal).clamp_min(_SMALLEST_SCALE)
    count = len(z)
    identity = z.new_tensor([1.0, 0.0, 0.0, 0.0])
    logit = math.log(config.opacity / (1 - config.opacity))
    return GaussianMap(
        means,
        identity.expand(count, 4).clone(),
        scales.log()[:, None].expand(count, 3).clone(),
        torch.full_like(z, logit),
        image[row, column].to(z),
        torch.full((count,), keyframe_index, dtype=torch.int64, device=z.device),
    )
