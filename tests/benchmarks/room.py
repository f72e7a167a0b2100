"""The scene that is timed: a textured box room, seen by a stratified RGB-D back-projection."""

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.splatting import GaussianMap

ROOM = 4.0  # world units, half the side of the room; the camera stands near its centre
INNER_BOX = (0.6, 0.4, 2.0)  # half side, height of the centre, distance of the inner box
RADIUS_RANGE = (2.0, 6.0)  # px, three standard deviations of a Gaussian in the image
MEAN_OPACITY_LOGIT = 0.4  # opacity 0.6


def room_camera(width: int, height: int) -> Camera:
    """Return a camera of 60 degrees horizontal view."""
    focal = width / 2 / 0.57735
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def room_scene(camera: Camera, count: int, seed: int) -> tuple[GaussianMap, Tensor]:
    """Return a map of `count` Gaussians on the surfaces seen, and a pose 5 cm and 1 degree off."""
    source = torch.Generator().manual_seed(seed)
    pixels = _stratified_pixels(camera, count, source)
    depths = _room_depth(camera.rays(pixels))
    means = camera.backproject(pixels, depths)
    colors = 0.5 + 0.5 * torch.sin(means * torch.tensor([3.0, 4.0, 5.0]))
    low, high = RADIUS_RANGE
    radii = low + (high - low) * torch.rand(count, 3, generator=source)
    scales = radii / 3 * depths[:, None] / camera.fx
    logits = MEAN_OPACITY_LOGIT + torch.randn(count, generator=source)
    quats = torch.randn(count, 4, generator=source)
    anchors = torch.zeros(count, dtype=torch.int64)
    T_camera_world = se3_exp(torch.tensor([0.03, -0.03, 0.027, 0.01, 0.01, -0.01]))
    return GaussianMap(means, quats, scales.log(), logits, colors, anchors), T_camera_world


def _stratified_pixels(camera: Camera, count: int, source: torch.Generator) -> Tensor:
    """Return one random pixel (count, 2) in each of `count` cells of equal area, about."""
    columns = round((count * camera.width / camera.height) ** 0.5)
    rows = -(-count // columns)
    cell = torch.stack(torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1)
    cell = cell.reshape(-1, 2)[torch.randperm(rows * columns, generator=source)[:count]]
    unit = (cell + torch.rand(count, 2, generator=source)) / torch.tensor([columns, rows])
    return unit * torch.tensor([camera.width, camera.height]) - 0.5


def _room_depth(rays: Tensor) -> Tensor:
    """Return the depth (N,) of the nearest wall, or of the inner box in front of it."""
    room = (ROOM / rays.abs()).amin(-1)
    half, height, distance = INNER_BOX
    front = distance - half
    hit = front * rays
    on_box = (hit[:, 0].abs() < half) & ((hit[:, 1] - height).abs() < half)
    return torch.where(on_box, front, room)
