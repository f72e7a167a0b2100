"""The memory of a run: what is seldom read lies in a file, and what was freed is given back.

Images, features, depths and flow of old keyframes are put on a `Shelf`, so the memory of a long run
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
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

SMALLEST = 1 << 12  # bytes, a page: smaller tensors stay in memory
FIRST_BLOCK, LARGEST_BLOCK = 1 << 24, 1 << 28  # bytes: each block is as large as all before it
PIECE = 1 << 20  # bytes, written at once
ALIGNMENT = 64  # bytes, that of tensors in memory: another one can change the last bits of sums


class Shelf:
    """Holds tensors in temporary files (of TMPDIR), which vanish with the last of their tensors."""

    def __init__(self) -> None:
        self._blocks: list[tuple[weakref.ref[mmap.mmap], int, int]] = []  # address, bytes
        self._free = torch.empty(0, dtype=torch.uint8)  # the rest of the newest block

    def put(self, tensors: Iterable[Tensor | None]) -> None:
        """Move tensors (any shape) to the file, for all that hold them; then release.

        What is there already, small, not contiguous or on a GPU is left alone, and so is what finds
        no room on the disk.
        """
        for tensor in tensors:
            if tensor is None or tensor.device.type != "cpu" or not tensor.is_contiguous():
                continue
            if tensor.nbytes >= SMALLEST and not self.holds(tensor) and self._has_room(tensor):
                place, rest = self._free.tensor_split([tensor.nbytes])
                self._free = rest[-tensor.nbytes % ALIGNMENT :]
                tensor.data = place.view(tensor.dtype).view(tensor.shape).copy_(tensor)
        self.release()

    def array(self, values: np.ndarray) -> np.ndarray:
        """Return an array as `put` leaves a tensor of its values; the given one stays in memory."""
        self.put([tensor := torch.from_numpy(values)])
        return tensor.numpy()

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether a tensor is here."""
        address = tensor.data_ptr()
        return any(
            first <= address < first + length and block() is not None
            for block, first, length in self._blocks
        )

    def release(self) -> None:
        """Give back the memory of what was read or put since; the file has it."""
        for block, _, _ in self._blocks:
            if (mapped := block()) is not None and hasattr(mmap, "MADV_DONTNEED"):
                mapped.madvise(mmap.MADV_DONTNEED)

    def _has_room(self, tensor: Tensor) -> bool:
        """Begin another block if a tensor needs one; tell whether it has a place now."""
        if tensor.nbytes > len(self._free):
            self._blocks = [block for block in self._blocks if block[0]() is not None]
            held = sum(length for *_, length in self._blocks)
            wanted = max(tensor.nbytes, min(max(held, FIRST_BLOCK), LARGEST_BLOCK))
            try:
                with tempfile.TemporaryFile() as file:
                    _fill(file, wanted)
                    mapped = mmap.mmap(file.fileno(), 0)
            except OSError:
                return False
            self._free = torch.frombuffer(mapped, dtype=torch.uint8)
            self._blocks.append((weakref.ref(mapped), self._free.data_ptr(), len(self._free)))
        return True


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


def _fill(file: BinaryIO, length: int) -> None:
    """Take room on the disk: a full one is an error here, but a crash once pages are written."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, length)
        return
    for first in range(0, length, PIECE):
        file.write(bytes(min(PIECE, length - first)))
    file.flush()
