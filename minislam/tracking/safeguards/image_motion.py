"""How fast the image moves, and how far a rolling shutter displaces it.

The flow between neighbouring frames tells it without any pose.
"""

import math

import numpy as np
import torch
from torch import Tensor

from minislam.priors.dense_flow import dense_from_grid, grayscale, residual_flow
from minislam.records import Frame
from minislam.state.stateful import Stateful
from minislam.tracking.grid import Grid

Readout = tuple[float, float]  # s, from left to right and from top to bottom

NEGLIGIBLE = 0.1  # px; an image that is displaced by less is left as it is


class ImageMotion(Stateful):
    """The velocity of each cell of the image in each frame seen."""

    velocities: list[Tensor]  # per frame u (2, N) px/s, by the frame before it
    shortest_step: float = math.inf  # s between two frames: no readout is longer
    _newest: Frame | None = None

    def __init__(self, grid: Grid) -> None:
        self._grid, self.velocities = grid, []

    def see(self, frame: Frame) -> None:
        """Measure how the image has moved since the frame before. Frames come in their order."""
        before, self._newest = self._newest, frame
        del self.velocities[frame.frame_index :]
        velocity = torch.zeros_like(self._grid.pixels.T)
        if before is not None and before.frame_index == frame.frame_index - 1:
            seconds = frame.timestamp - before.timestamp
            back = residual_flow(grayscale(frame.image), grayscale(before.image))
            cells = back[:: self._grid.stride, :: self._grid.stride].reshape(-1, 2).T.copy()
            velocity = torch.from_numpy(cells).to(velocity) / -seconds
            self.shortest_step = min(self.shortest_step, seconds)
        self.velocities.append(velocity)

    def velocity(self, frame_index: int) -> Tensor:  # (2, N) px/s
        """Return how fast the image of a frame moves: the mean of before and after it."""
        around = self.velocities[max(frame_index, 1) : frame_index + 2]  # none before the first
        return torch.stack(around).mean(0) if around else torch.zeros_like(self._grid.pixels.T)

    def displacement(self, frame_index: int, readout: Readout) -> np.ndarray | None:  # (H, W, 2)
        """Return how far each pixel is from where a global shutter shows it; None: negligible."""
        if not any(readout):
            return None
        grid, camera = self._grid, self._grid.camera
        late = grid.pixels.T / grid.pixels.new_tensor([[camera.width], [camera.height]]) - 0.5
        moved = self.velocity(frame_index) * (grid.pixels.new_tensor(readout) @ late)
        if not moved.abs().max() > NEGLIGIBLE:
            return None
        cells = (grid.pixels + moved.T).reshape(*grid.shape, 2).cpu().numpy()
        return dense_from_grid(cells, (camera.height, camera.width), grid.stride)
