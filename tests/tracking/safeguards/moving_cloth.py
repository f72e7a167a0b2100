"""Pictures of a cloth that moves sideways before the camera."""

import cv2
import numpy as np
import torch

from minislam.geometry import Camera
from minislam.records import Frame
from minislam.tracking.grid import Grid

WIDE = Camera(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)
GRID = Grid.of(WIDE, 8)
RATE = 20.0  # frames per second
CLOTH = cv2.GaussianBlur(np.random.default_rng(1).random((120, 200)).astype(np.float32), None, 1.5)


def texture(columns: np.ndarray | float) -> np.ndarray:  # (H, W, 3)
    """Return a texture that has moved to the right by some pixels, a number or one for each row."""
    row, column = np.mgrid[:120, :160].astype(np.float32)
    moved = np.float32(column + 20 - columns)
    grey = 0.5 + 2 * (cv2.remap(CLOTH, moved, row, cv2.INTER_CUBIC) - 0.5)
    return np.repeat(grey[..., None], 3, 2)


def picture(index: int, columns: np.ndarray | float) -> Frame:
    pixels = np.round(255 * texture(columns)).astype(np.uint8)
    return Frame(index, index / RATE, torch.from_numpy(pixels))
