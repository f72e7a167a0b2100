"""Raw images: files of a folder, or frames of a video."""

import os
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from minislam.data.images import is_text, read_color
from minislam.data.metadata import noted_size
from minislam.data.picture import Glance, glance_at
from minislam.errors import InputError, MinislamError, require

SIMILAR = 0.03  # of a side: images that differ by less are resized [-]
_MOST_FAILURES = 300  # calls of grab() in a row, behind which no frame is looked for
_TEXT = cv2.VideoWriter.fourcc(*"ansi")  # FFmpeg films a text file on a terminal
_CLOCK_RATE = 10  # frames: with more between two stamps, the rate noted is that of a clock
_CONSTANT_RATE = 0.1  # frames; containers round timestamps to milliseconds


class FileImages:
    """Images that are files. The size of most of them counts.

    Those of nearly that size, as COLMAP undistorts them, are resized; the others are left out.
    """

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths
        noted = enumerate(map(noted_size, paths))
        sizes = {k: size for k, size in noted if size is not None and min(size) > 0}
        usual = Counter(sizes.values()).most_common(1)
        self._size = width, height = usual[0][0] if usual else (0, 0)
        # By number, what is said of an image that is resized, and of one that is left out.
        self.resized, self.odd = dict[int, str](), dict[int, str]()
        for k, (w, h) in sizes.items():
            change = max(abs(w / width - 1), abs(h / height - 1))
            said = self.resized if change < SIMILAR else self.odd
            if change > 0:
                said[k] = f"{paths[k].name} is {w}x{h} px, others are {width}x{height}"
        self.labels = [str(path) for path in paths]  # how to call the images in a message
        self.names = [path.name for path in paths]

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB."""
        return self.as_usual(index, read_color(self.paths[index]))

    def as_usual(self, index: int, image: np.ndarray) -> np.ndarray:
        """Return an image, or the mask or depth (H, W) that belongs to it, at the size of most."""
        if index not in self.resized:
            return image
        method = cv2.INTER_AREA if image.ndim == 3 else cv2.INTER_NEAREST_EXACT
        numbers = image.astype(np.uint8) if image.dtype == bool else image
        return cv2.resize(numbers, self._size, None, 0, 0, method).astype(image.dtype)

    @property
    def glances(self) -> list[Glance]:
        """Return a glance at each sampled image."""
        usual = [index for index in range(len(self.paths)) if index not in self.odd]
        found = [glance_at(first := self.read(usual[0]))]
        for place in filter(_is_sampled, range(1, len(usual))):
            with suppress(MinislamError):  # raised again when that frame is read
                image = self.read(usual[place])
                found += [glance_at(image)] if image.shape == first.shape else []
        return found


class VideoImages:
    """Images that are frames of a video. OpenCV applies the rotation that phones note in it.

    The frame count of a container is an estimate, and seeking is inexact. So the frames are counted
    by reading through the file, and an earlier frame is looked for from the beginning again. What
    cannot be decoded is passed over.
    """

    def __init__(self, path: Path, limit: int | None = None) -> None:
        self.path, self.paths = path, [path]  # the files that hold the images
        self.resized, self.odd = dict[int, str](), dict[int, str]()
        self._rewind()
        self._calls: list[int] = []  # of grab(), after which a frame can be had
        self.frame_rate = self._capture.get(cv2.CAP_PROP_FPS)
        self.glances: list[Glance] = []  # at the sampled images
        stamps: list[float] = []
        last = 0  # A failed call is the end of the file, or damage with more frames behind it.
        while len(stamps) != limit and self._grabbed < last + _MOST_FAILURES:
            self._grabbed += 1
            if self._capture.grab():
                last = self._grabbed
                self._calls.append(self._grabbed)
                if _is_sampled(len(stamps)):
                    decoded, image = self._capture.retrieve()
                    if decoded:
                        self.glances.append(glance_at(image))
                stamps.append(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        # The container counts all frames: its count says nothing if reading stopped at the limit.
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0  # s
        if usual > 0 and self.frame_rate * usual > _CLOCK_RATE:
            self.frame_rate, promised = 1 / usual, 0
        self.promised = 0 if len(stamps) == limit else promised  # 0 or less: unknown
        self.timestamps = np.array(stamps)  # (N,) second, as the container has them
        self.labels = [f"frame {index} of {path}" for index in range(len(stamps))]
        self.names = [f"{path.stem}_{index:06d}" for index in range(len(stamps))]
        self.is_whole = not self._capture.grab()  # no image follows
        self._rewind()

    def __len__(self) -> int:
        return len(self._calls)

    def read(self, index: int) -> np.ndarray:
        """Return a raw image (H, W, 3) uint8 RGB; walking forward decodes every frame once."""
        if self._calls[index] < self._grabbed:
            self._rewind()
        while self._grabbed < self._calls[index]:
            self._capture.grab()
            self._grabbed += 1
        _, image = self._capture.retrieve()
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def unread(self) -> np.ndarray:  # (M,) second
        """Return about when frames are missing: gaps of a constant rate, or calls that failed."""
        gaps = np.diff(self.timestamps) * self.frame_rate  # frames
        missing = np.diff(self._calls) - 1
        if self.promised > len(self) > 1 and np.median(np.abs(gaps - 1)) < _CONSTANT_RATE:
            missing = np.maximum(missing, np.round(gaps).astype(int) - 1)
        rows = zip(self.timestamps, self.timestamps[1:], missing, strict=False)
        return np.concatenate([[], *(np.linspace(a, b, n + 2)[1:-1] for a, b, n in rows)])

    def _rewind(self) -> None:
        # FFmpeg, because other back ends may take the name for a camera or a pattern.
        # It takes what precedes a colon for a protocol.
        name = os.path.abspath(self.path)
        require(is_text(name), "a video whose name is text", f"{name!a}; rename it")
        self._capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
        self._grabbed = 0  # calls of grab() since the start
        codec = self._capture.get(cv2.CAP_PROP_FOURCC)
        if not self._capture.isOpened() or codec == _TEXT:
            size, hint = self.path.stat().st_size, "convert it to MP4 (H.264) or give images"
            content = np.memmap(self.path, mode="r").data if size else memoryview(b"")
            # The table of contents, which cameras write at the end of an MP4
            if content[4:8] == b"ftyp" and not re.search(b"(?s)moov....mvhd", content):
                hint = "the file is cut short, copy it again"
            found = f"{self.path} ({size} bytes) cannot be opened as one; {hint}"
            raise InputError(f"expected a video, but {found}")


def _is_sampled(index: int) -> bool:
    """Tell whether an image is sampled: 0, 1, 2, 4, 8, ..., few and far apart."""
    return index & (index - 1) == 0


ImageSource = FileImages | VideoImages
