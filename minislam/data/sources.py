"""Raw images, files in a folder or a video, and what lies beside them in a recording."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from minislam.data.calibration import Calibration
from minislam.data.images import list_images, read_color
from minislam.errors import InputError
from minislam.records import Trajectory

FILES = "files:"  # before the name of a folder

# Assumed when neither the file names nor the container state the frame rate.
ASSUMED_FRAME_RATE = 30.0  # frames per second
_MOST_FAILURES = 300  # calls of grab() in a row, behind which no frame is looked for
_CONSTANT_RATE = 0.1  # frames; containers round timestamps to milliseconds


class FileImages:
    """Images that are files."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths
        self.labels = [str(path) for path in paths]  # how to call the images in a message
        self.names = [path.name for path in paths]

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB."""
        return read_color(self.paths[index])


class VideoImages:
    """Images that are frames of a video. OpenCV applies the rotation that phones note in it.

    The frame count in a container is an estimate, and seeking is inexact for many codecs.
    Therefore the frames are counted by reading through the file once, and reading an earlier
    frame starts again at the beginning. What cannot be decoded is passed over.
    """

    def __init__(self, path: Path, limit: int | None = None) -> None:
        self.path, self.paths = path, [path]  # the files that hold the images
        self._capture = _open_capture(path)
        self._grabbed = 0  # calls of grab() since the start
        self._calls: list[int] = []  # of grab(), after which a frame can be had
        self.frame_rate = self._capture.get(cv2.CAP_PROP_FPS)
        self.promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))  # 0 or less if unknown
        stamps: list[float] = []
        last = 0  # A failed call is the end of the file, or damage with more frames behind it.
        while len(stamps) != limit and self._grabbed < last + _MOST_FAILURES:
            self._grabbed += 1
            if self._capture.grab():
                last = self._grabbed
                self._calls.append(self._grabbed)
                stamps.append(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        self.timestamps = np.array(stamps)  # (N,) second, as the container has them
        self.labels = [f"frame {index} of {path}" for index in range(len(stamps))]
        self.names = [f"{path.stem}_{index:06d}" for index in range(len(stamps))]
        self._rewind()

    def __len__(self) -> int:
        return len(self._calls)

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB; walking forward decodes every frame once.

        The same frame may be read again at once: an export needs it in two sizes.
        """
        if self._calls[index] < self._grabbed:
            self._rewind()
        while self._grabbed < self._calls[index]:
            self._capture.grab()
            self._grabbed += 1
        _, image = self._capture.retrieve()
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def lost(self) -> np.ndarray:  # (M,) second
        """Return about when frames are missing: gaps of a constant rate, or calls that failed."""
        gaps = np.diff(self.timestamps) * self.frame_rate  # frames
        missing = np.diff(self._calls) - 1
        if self.promised > len(self) > 1 and np.median(np.abs(gaps - 1)) < _CONSTANT_RATE:
            missing = np.maximum(missing, np.round(gaps).astype(int) - 1)
        rows = zip(self.timestamps, self.timestamps[1:], missing, strict=False)
        return np.concatenate([[], *(np.linspace(a, b, n + 2)[1:-1] for a, b, n in rows)])

    def _rewind(self) -> None:
        self._capture.release()
        self._capture = _open_capture(self.path)
        self._grabbed = 0


ImageSource = FileImages | VideoImages


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


def _open_capture(path: Path) -> cv2.VideoCapture:
    """Open a video with FFmpeg; other back ends may take the name for a camera or a pattern."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(
            f"expected a video, but {path} ({path.stat().st_size} bytes) cannot be opened as one; "
            "convert it to MP4 (H.264) or give a folder of images"
        )
    return capture
