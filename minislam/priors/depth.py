"""Metric depth of single images without a network, each a `DepthPrior`: simulated, sensor, none."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.errors import InputError, require
from minislam.geometry import Camera
from minislam.records import Frame, FramePicture

_FIELD_CELLS = 4  # bumps of the smooth error along the shorter image side
_RANGE = (1e-4, 1e5)  # world units; what is nearer or farther is no depth of a scene
_GROSS_ERROR = 0.3  # relative error at a gross error, of either sign
_GROSS_RADIUS = 0.12  # shorter image sides, radius of a gross error
_ASPECT_TOLERANCE = 0.02  # relative; rounding a resized image to whole pixels stays below it


@dataclass(frozen=True)
class SimulatedDepth:
    """The true depth of a synthetic scene with errors as large as those of good metric networks.

    The errors of a frame depend on the seed and the frame index alone, not on the order of calls.
    """

    truth: FramePicture  # (H, W) world units, 0 unknown
    seed: int
    scale_error: float = 0.03  # standard deviation of one log factor per frame
    field_error: float = 0.06  # standard deviation of a smooth log factor in the image
    gross_errors: int = 2  # places per frame with an error of 30 %

    def __call__(self, frame: Frame, camera: Camera) -> Tensor | None:
        """Return the disturbed truth of a frame."""
        truth = self.truth(frame.frame_index)
        if truth is None:
            return None
        source = np.random.default_rng([self.seed, frame.frame_index])
        height, width = truth.shape
        of_scale = self.scale_error * source.standard_normal()
        of_field = self.field_error * _smooth_noise(width, height, source)
        log_factor = of_scale + of_field + self._gross(width, height, source)
        return as_depth(truth * np.exp(log_factor), frame, "the simulated depth")

    def _gross(self, width: int, height: int, source: np.random.Generator) -> np.ndarray:
        """Return the log factor (H, W) of the gross errors."""
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        radius = _GROSS_RADIUS * min(width, height)
        total = np.zeros((height, width))
        for _ in range(self.gross_errors):
            centre_u, centre_v = source.uniform(0, width), source.uniform(0, height)
            sign = source.choice([-1.0, 1.0])
            distance = np.hypot(u - centre_u, v - centre_v) / radius
            # Flat inside, falling to zero over the last third: networks err by whole objects.
            total += np.log1p(sign * _GROSS_ERROR) * np.clip(3 * (1 - distance), 0, 1)
        return total


@dataclass(frozen=True)
class SensorDepth:
    """Depth of an RGB-D camera, as the sequence's own reader returns it."""

    reader: FramePicture  # (H, W) world units, 0 unknown

    def __call__(self, frame: Frame, camera: Camera) -> Tensor | None:
        """Return the sensor's depth of a frame, or None where it has none."""
        depth = self.reader(frame.frame_index)
        return None if depth is None else as_depth(depth, frame, "the sensor's depth")


class NoDepth:
    """No depth prior: the scale of the world is then arbitrary."""

    def __call__(self, frame: Frame, camera: Camera) -> None:
        """Return None."""


def _smooth_noise(width: int, height: int, source: np.random.Generator) -> np.ndarray:  # (H, W)
    """Return smooth noise of mean 0 and standard deviation 1 over the image."""
    cell = min(width, height) / _FIELD_CELLS
    coarse = source.standard_normal((round(height / cell) + 1, round(width / cell) + 1))
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return (noise - noise.mean()) / (noise.std() or 1.0)


def as_depth(depth: np.ndarray, frame: Frame, name: str) -> Tensor:
    """Return depth as (H, W) float32 of the frame's size, with 0 for everything unusable."""
    height, width = frame.image.shape[:2]
    aspect = (depth.shape[1] / depth.shape[0]) / (width / height)
    wanted = f"{name} to show what the image of {width}x{height} shows"
    found = f"{depth.shape[1]}x{depth.shape[0]} of another aspect ratio; crop it like the image"
    require(abs(aspect - 1) <= _ASPECT_TOLERANCE, wanted, found)
    depth = np.asarray(depth, np.float32)
    if depth.shape != (height, width):
        # Not bilinear: a mean over an object's edge is a depth where nothing is.
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    known = np.isfinite(depth) & (depth > 0)
    usable = known & (depth > _RANGE[0]) & (depth < _RANGE[1])
    if known.any() and not usable.any():
        wanted = f"depths of {_RANGE[0]:g} to {_RANGE[1]:g} world units in {name}"
        found = f"{depth[known].min():g} to {depth[known].max():g}; write metres"
        raise InputError(f"expected {wanted}, found {found}")
    return torch.from_numpy(np.where(usable, depth, np.float32(0))).to(frame.image.device)
