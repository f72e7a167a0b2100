"""Prepared images in a temporary file, so that each frame is decoded and resized once.

A run looks at every frame about six times, and not in order. In a video a step back takes ten
times as long as a step on, because decoding starts again at an earlier complete image.
"""

import tempfile
from collections.abc import Callable
from typing import IO

import numpy as np


class KeptImages:
    """Keeps images of one shape by their numbers. Where a disk is full, it keeps no more."""

    def __init__(self) -> None:
        self._slots: dict[int, int] = {}  # image number: place in the file
        self._shape: tuple[int, ...] = ()
        self._file: IO[bytes] | None = None  # the system removes it, however the program ends

    def get(self, number: int, prepare: Callable[[], np.ndarray]) -> np.ndarray:
        """Return image `number` (H, W, 3) uint8; `prepare` makes it when it is asked for first."""
        if number in self._slots and self._file is not None:
            image = np.empty(self._shape, np.uint8)
            self._file.seek(self._slots[number] * image.nbytes)
            image.data.cast("B")[:] = self._file.read(image.nbytes)
            return image
        image = prepare()
        self._shape = image.shape
        try:
            self._file = self._file or tempfile.TemporaryFile()
            self._file.seek(len(self._slots) * image.nbytes)
            self._file.write(image.tobytes())
            self._file.flush()
            self._slots[number] = len(self._slots)
        except OSError:  # the image is prepared again next time
            pass
        return image
