"""What a reader found, before any frame is chosen or resized."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from minislam.data.calibration import Calibration
from minislam.data.sources import ImageSource
from minislam.records import Trajectory


@dataclass(frozen=True)
class Recording:
    """Raw images with timestamps, and whatever else lies beside them.

    The lists of paths are empty, or have one entry per image: None where there is no such file.
    """

    name: str  # short, usable as a folder name
    kind: str  # what it is, for the description
    images: ImageSource
    timestamps: np.ndarray  # (N,) float64 second, strictly increasing
    calibration: Calibration | None = None  # None: unknown
    trajectory: Trajectory | None = None  # ground truth
    depth_paths: list[Path | None] = field(default_factory=list)
    mask_paths: list[Path | None] = field(default_factory=list)
    static_paths: list[Path | None] = field(default_factory=list)
    novel_views: list[tuple[np.ndarray, Path]] = field(default_factory=list)  # (T_world_camera, .)
    notes: list[str] = field(default_factory=list)  # more for the description
    warnings: list[str] = field(default_factory=list)

    def depth_path(self, index: int) -> Path | None:
        """Return the depth image that belongs to a colour image."""
        return self.depth_paths[index] if self.depth_paths else None

    def mask_path(self, index: int) -> Path | None:
        """Return the mask of the movers in an image."""
        return self.mask_paths[index] if self.mask_paths else None

    def static_path(self, index: int) -> Path | None:
        """Return the same view without movers."""
        return self.static_paths[index] if self.static_paths else None

    def has_truth(self) -> bool:
        """Tell whether there is anything to compare with; sensor depth alone is an input."""
        views = [*self.mask_paths, *self.static_paths, *self.novel_views]
        return self.trajectory is not None or any(view is not None for view in views)
