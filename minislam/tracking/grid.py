"""The grid of cells on which the tracker works."""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.state.stateful import Stateful
from minislam.tracking.safeguards.focal_column import zoomed


@dataclass
class Grid(Stateful):
    """The cells of the tracker: every `stride`-th pixel of the image."""

    camera: Camera
    stride: int  # px
    shape: tuple[int, int]  # (h, w)
    pixels: Tensor  # (N, 2) px
    rays: Tensor  # (N, 3), z = 1

    @classmethod
    def of(cls, camera: Camera, stride: int, device: str = "cpu") -> "Grid":
        """Return the grid of a camera."""
        pixels = camera.pixel_grid(stride, device=device)
        height, width = pixels.shape[:2]
        flat = pixels.reshape(-1, 2)
        return cls(camera, stride, (height, width), flat, camera.rays(flat))

    def zoom(self, log_focal: float) -> None:
        """Make both focal lengths exp(log_focal) times as long, for all who hold this grid."""
        self.camera, self.rays = zoomed(self.camera, self.rays, log_focal)

    def cells_at(self, positions: Tensor) -> tuple[Tensor, Tensor]:  # (2, N) px -> (N,), (N,) bool
        """Return the nearest cell of each position, and whether it is in the image."""
        column, row = (positions / self.stride).round().long()
        height, width = self.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return row * width + column, inside

    def sample(self, values: Tensor, positions: Tensor) -> Tensor:
        """Interpolate the cells' values (..., N, C) at pixels (..., M, 2); the border repeats."""
        height, width = self.shape
        image = values.reshape(-1, height, width, values.shape[-1]).permute(0, 3, 1, 2)
        extent = positions.new_tensor([width - 1, height - 1]) * self.stride
        normalised = (2 * positions / extent - 1).reshape(len(image), 1, -1, 2)
        sampled = torch.nn.functional.grid_sample(
            image, normalised.to(image.dtype), align_corners=True, padding_mode="border"
        )
        return sampled[:, :, 0].mT.reshape(*positions.shape[:-1], values.shape[-1])
