"""A textured wall in front of a sliding camera, with or without a moving square."""

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping import InsertionConfig, Mapper, MappingConfig
from minislam.records import MapImage
from minislam.uncertainty import UncertaintyConfig
from minislam.workers import Workers

WALL_DEPTH = 2.0  # world units
CAMERA = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
GRID = (6, 8)  # cells of the feature grid
CONFIG = MappingConfig(
    image_scale=1.0,
    init_iterations=60,
    keyframe_iterations=5,
    insertion=InsertionConfig(cell=2),
)
UNCERTAINTY = UncertaintyConfig(learning_rate=5e-3)


def make_mapper(
    config: MappingConfig = CONFIG,
    uncertainty: UncertaintyConfig = UNCERTAINTY,
    workers: Workers | None = None,
) -> Mapper:
    return Mapper(CAMERA, config, uncertainty, feature_dimension=3, seed=0, workers=workers)


def wall_color(x: Tensor, y: Tensor) -> Tensor:
    """Return a smooth colour (..., 3) for each place on the wall."""
    waves = [3.1 * x + y, 2.3 * y - x, 2.9 * x - 1.7 * y]
    return torch.stack([0.5 + 0.35 * torch.sin(2 * wave) for wave in waves], -1)


def pose(shift: float) -> Tensor:
    """Return T_camera_world of a camera that moved right by `shift` world units."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -shift
    return transform


def wall_keyframe(index: int, mover_column: int | None = None) -> MapImage:
    """Return keyframe `index`; a white square of 8 px stands at depth 1 if a column is given."""
    shift = 0.1 * index
    grid = CAMERA.pixel_grid()
    points = CAMERA.backproject(grid, torch.full(grid.shape[:2], WALL_DEPTH))
    image = wall_color(points[..., 0] + shift, points[..., 1])
    depth = torch.full(grid.shape[:2], WALL_DEPTH)
    features = torch.zeros(*GRID, 3)
    features[..., 0] = 1
    if mover_column is not None:
        square = (slice(8, 16), slice(mover_column, mover_column + 8))
        image[square] = 1.0
        depth[square] = 1.0
        first = mover_column // 4
        features[2:4, first : first + 2] = torch.tensor([0.0, 1.0, 0.0])
    return MapImage(5 * index, image, features, depth, pose(shift))
