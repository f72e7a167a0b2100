"""Sources of raw images: files in a folder, or a video."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from minislam.data.images import read_color
from minislam.errors import InputError

# Assumed when neither the file names nor the container state the frame rate.
ASSUMED_FRAME_RATE = 30.0  # frames per second


class ImageSource(Protocol):
    """Raw images in order, each of which can be read again."""

    def __len__(self) -> int:
        """Return the number of images."""

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB."""

    def label(self, index: int) -> str:
        """Return how to call this image in a message."""


@dataclass(frozen=True)
class FileImages:
    """Images that are files."""

    paths: list[Path]

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB."""
        return read_color(self.paths[index])

    def label(self, index: int) -> str:
        """Return the path of an image."""
        return str(self.paths[index])


class VideoImages:
    """Images that are frames of a video. OpenCV applies the rotation that phones note in it.

    The frame count in a container is an estimate, and seeking is inexact for many codecs.
    Therefore the frames are counted by reading through the file once, and reading an earlier
    frame starts again at the beginning.
    """

    def __init__(self, path: Path, limit: int | None = None) -> None:
        self.path = path
        self._capture = _open_capture(path)
        self._next = 0  # the frame that the capture returns next
        self.frame_rate = self._capture.get(cv2.CAP_PROP_FPS)
        self._count = 0
        while (limit is None or self._count < limit) and self._capture.grab():
            self._count += 1
        self._rewind()

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB; walking forward decodes every frame once."""
        if index < self._next:
            self._rewind()
        while self._next < index and self._capture.grab():
            self._next += 1
        whole, image = self._capture.read()
        if not whole:
            raise InputError(
                f"expected {self._count} readable frames, but {self.label(index)} cannot be "
                "decoded; convert the video anew"
            )
        self._next = index + 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def label(self, index: int) -> str:
        """Return how to call this frame in a message."""
        return f"frame {index} of {self.path}"

    def _rewind(self) -> None:
        self._capture.release()
        self._capture = _open_capture(self.path)
        self._next = 0


def _open_capture(path: Path) -> cv2.VideoCapture:
    """Open a video with FFmpeg; other back ends may take the name for a camera or a pattern."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(
            f"expected a video, but {path} ({path.stat().st_size} bytes) cannot be opened as one; "
            "convert it to MP4 (H.264) or give a folder of images"
        )
    return capture
