"""Insert Gaussians for what a keyframe sees and the map does not explain, and withdraw movers."""

import math

import torch
from torch import Tensor
from torch.nn import functional

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
    and the map transparent there. Where the map shows another surface nothing is added: if the
    new one is nearer it may be a mover that the MLP does not know yet, and if it is farther the
    old one is a mover's remainder, which `lies_on_mover` finds, or the blurred edge of an object.
    """
    wanted = (depth > 0) & (depth < far_limit) & (weight > 0)
    if rendering is not None:
        wanted &= rendering.opacity < config.explained_opacity
    return wanted


def draw_pixels(
    known: Tensor,  # (H, W) bool
    cell: int,  # px, side of a cell
    generator: torch.Generator,
) -> Tensor:  # (M, 2) int64, column and row
    """Draw one random known pixel in each cell x cell square of the image that has any.

    A stratified subset: as random as the paper's, without its clumps and holes, and no fewer
    where the depth is sparse.
    """
    height, width = known.shape
    lottery = torch.rand(height, width, generator=generator).to(known.device)
    lottery = torch.where(known, lottery, -1)
    best, winner = functional.max_pool2d(lottery[None], cell, ceil_mode=True, return_indices=True)
    winner = winner[best >= 0]
    return torch.stack([winner % width, winner // width], -1)


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


def lies_on_mover(
    means: Tensor,  # (N, 3) world units
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4) float64, of the keyframe they were inserted for
    weight: Tensor,  # (H, W) static weight of that keyframe, 0 on movers
) -> Tensor:  # (N,) bool
    """Tell which Gaussians their own keyframe sees where it now knows a mover.

    They were inserted when the MLP had not learnt it yet. Had it known, `insertable_pixels` would
    not have let them in, so they leave: they are the mover's surface, seen from where it was.
    """
    points = transform_points(T_camera_world, means.double())
    in_front = points[:, 2] > 0
    # Points behind the camera have no pixel; any depth that is not zero will do for them.
    pixels = camera.project(torch.where(in_front[:, None], points, torch.ones_like(points)))
    # Optimisation may have pushed a Gaussian over the border: the nearest pixel speaks for it.
    column = pixels[:, 0].round().clamp(0, camera.width - 1).long()
    row = pixels[:, 1].round().clamp(0, camera.height - 1).long()
    return in_front & (weight[row, column] == 0)
