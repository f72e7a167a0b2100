"""The memory of a run: what is seldom read lies in a file, and what was freed is given back.

Images, features, depths and flow of keyframes are put on the `SHELF`, so the memory of a long run
does not grow by them. Whoever holds such a tensor notices nothing.
"""

import ctypes
import mmap
import os
import sys
import tempfile
import weakref
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

SMALLEST = 1 << 12  # bytes, a page: smaller tensors stay in memory
FIRST_BLOCK, LARGEST_BLOCK = 1 << 24, 1 << 28  # bytes: each block is as large as all before it
PIECE = 1 << 20  # bytes that are written at once
_BLOCKS: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()  # of all shelves
ALIGNMENT = 64  # bytes, as tensors in memory: another one can change the last bits of sums


class Shelf:
    """Holds tensors in files of TMPDIR. Each vanishes with the shelf and the last tensor in it."""

    def __init__(self) -> None:
        self._blocks: list[mmap.mmap] = []
        self._used = 0  # bytes of the newest block
        self._spare: dict[int, list[tuple[mmap.mmap, int]]] = {}  # by bytes: block, first byte

    def put(self, tensors: Iterable[Tensor | None]) -> None:
        """Move tensors (any shape) to the file, for all that hold them; then release.

        Left alone is what is there already, small, not contiguous, on a GPU, or finds no room.
        """
        for tensor in tensors:
            if tensor is None or tensor.device.type != "cpu" or not tensor.is_contiguous():
                continue
            if tensor.nbytes >= SMALLEST and not self.holds(tensor):
                with suppress(OSError):
                    place = torch.from_numpy(self.reserve(tensor.nbytes))
                    tensor.data = place.view(tensor.dtype).view(tensor.shape).copy_(tensor)
        release()

    def array(self, values: np.ndarray) -> np.ndarray:
        """Return a copy of an array in the file, if `put` moves it there; else the array itself."""
        self.put([tensor := torch.from_numpy(values)])
        return tensor.numpy()

    def rows(self, whole: Tensor) -> list[Tensor]:
        """Return copies of the rows of a tensor, each in a place of its own."""
        rows = [row.clone() for row in whole]  # views would keep the whole tensor
        self.put(rows)
        return rows

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether a tensor is here."""
        starts = [np.frombuffer(block, np.uint8).ctypes.data for block in self._blocks]
        ranges = zip(starts, map(len, self._blocks), strict=True)
        return any(start <= tensor.data_ptr() < start + length for start, length in ranges)

    def reserve(self, length: int) -> np.ndarray:  # (length,) uint8
        """Return bytes that are used again once the array is gone; OSError: the disk is full."""
        size = -(-length // ALIGNMENT) * ALIGNMENT
        spare = self._spare.setdefault(size, [])
        if spare:
            block, first = spare.pop()
        else:
            if not self._blocks or self._used + size > len(self._blocks[-1]):
                held = sum(map(len, self._blocks))
                self._blocks.append(_block(max(size, min(max(held, FIRST_BLOCK), LARGEST_BLOCK))))
                self._used = 0
            block, first = self._blocks[-1], self._used
            self._used += size
        place = np.frombuffer(block, np.uint8, length, first)
        weakref.finalize(place, spare.append, (block, first)).atexit = False
        return place


def _block(length: int) -> mmap.mmap:
    """Return so many bytes of a new file, with room on the disk: else writing them would crash."""
    with tempfile.TemporaryFile() as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, length)
        else:
            for first in range(0, length, PIECE):
                file.write(bytes(min(PIECE, length - first)))
            file.flush()
        _BLOCKS.add(block := mmap.mmap(file.fileno(), 0))
    return block


SHELF = Shelf()  # for all that a run keeps of its keyframes


def release() -> None:
    """Give back the memory of what was read from any shelf, or put there; the files have it."""
    for block in _BLOCKS:
        if hasattr(mmap, "MADV_DONTNEED"):
            block.madvise(mmap.MADV_DONTNEED)


def stack(rows: list[Tensor]) -> Tensor:
    """Return `torch.stack` of equal tensors; that of many lies in a file, which goes with it."""
    size, step = len(rows) * rows[0].nbytes, max(1, PIECE // rows[0].nbytes)
    if size > FIRST_BLOCK and rows[0].device.type == "cpu":
        with suppress(OSError):
            place = torch.from_numpy(Shelf().reserve(size)).view(rows[0].dtype)
            whole = place.view(len(rows), *rows[0].shape)
            for first in range(0, len(rows), step):
                torch.stack(rows[first : first + step], out=whole[first : first + step])
                release()
            return whole
    return torch.stack(rows)


def give_back_freed() -> None:
    """Give memory that was freed in pieces back to the system, which takes some milliseconds."""
    with suppress(OSError, TypeError, AttributeError):  # another C library than glibc has no way
        ctypes.CDLL(None).malloc_trim(0)


def peak_memory_mb() -> float | None:
    """Return the most memory this process has used so far [MB], or None on Windows."""
    try:
        import resource
    except ImportError:
        return None
    # What Linux returns counts the process that started this one, too; its status does not.
    status = Path("/proc/self/status")
    if sys.platform == "linux" and status.exists():
        _, _, rest = status.read_text(encoding="ascii", errors="replace").partition("VmHWM:")
        if rest:
            return int(rest.split()[0]) / 1024  # kB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024**2 if sys.platform == "darwin" else 1024)  # macOS: bytes
