"""What lies in a recording, before any frame is chosen or resized."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from minislam.data.calibration import Calibration
from minislam.data.images import list_images
from minislam.data.sources import FileImages, ImageSource
from minislam.errors import InputError
from minislam.records import Trajectory

FILES = "files:"  # before the name of a folder


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
    noted_focal_length: tuple[float, str] | None = None  # over the image diagonal, and its origin
    trajectory: Trajectory | None = None  # ground truth
    depth_paths: list[Path | None] = field(default_factory=list)
    mask_paths: list[Path | None] = field(default_factory=list)  # True on dynamic objects
    static_paths: list[Path | None] = field(default_factory=list)  # without dynamic objects
    novel_views: list[tuple[np.ndarray, Path]] = field(default_factory=list)  # (T_world_camera, .)
    lost: list[tuple[float, str]] = field(default_factory=list)  # timestamp [s], reason
    notes: list[str] = field(default_factory=list)  # more for the description
    warnings: list[str] = field(default_factory=list)

    def has_truth(self) -> bool:
        """Tell whether there is anything to compare with; sensor depth alone is an input."""
        views = [*self.mask_paths, *self.static_paths, *self.novel_views]
        return self.trajectory is not None or any(view is not None for view in views)


def mask_files(images: ImageSource, masks: str, chosen: range) -> list[Path | None]:
    """Return the mask of each image in files:FOLDER: of the image's name, or of its number."""
    folder = Path(masks.removeprefix(FILES)).expanduser()
    if not masks.startswith(FILES) or not folder.is_dir():
        raise InputError(
            f"expected --masks {FILES}FOLDER with a folder that exists, found {masks}; check it"
        )
    files = {path.stem: path for path in list_images(folder)}
    numbered = {int(name): path for name, path in files.items() if name.isdecimal()}
    found = [numbered.get(index) for index in range(len(images))]
    if isinstance(images, FileImages) and any(path.stem in files for path in images.paths):
        found = [files.get(path.stem) for path in images.paths]
    missing = [images.labels[index] for index in chosen if found[index] is None]
    if missing:
        raise InputError(
            f"expected a mask of every frame in {folder}, found none for {len(missing)} of "
            f"{len(chosen)}, such as {missing[0]}; name them like the images or by number from 0, "
            "and make a black one where nothing moves"
        )
    return found
