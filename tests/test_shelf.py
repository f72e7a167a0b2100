"""Tensors on the shelf: nobody notices, and their memory can be given back."""

import errno
import gc
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam import shelf as shelf_module
from minislam.shelf import Shelf, give_back_freed


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def resident() -> float:
    """Return the resident memory of this process [MB]."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmRSS:")[1].split()[0]) / 1e3


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64, torch.bool])
def test_values_stay_for_all_that_hold_them(dtype: torch.dtype) -> None:
    given = (noise(40, 50, 3) * 200).to(dtype)
    other, wanted = given, given.clone()
    shelf = Shelf()
    shelf.put([given])
    shelf.release()
    assert other.dtype == dtype and torch.equal(other, wanted)


def test_the_layout_stays_that_of_a_tensor_in_memory() -> None:
    shelf = Shelf()
    tensors = [noise(1000 + odd, 3) for odd in range(3)]
    shelf.put(tensors)
    assert [t.data_ptr() % shelf_module.ALIGNMENT for t in tensors] == [0, 0, 0]
    assert all(t.is_contiguous() for t in tensors)
    assert all(torch.equal(t, noise(len(t), 3)) for t in tensors)


def test_a_part_of_a_larger_tensor_leaves_it() -> None:
    whole = noise(4, 2000)
    part = whole[1]
    Shelf().put([part])
    assert part.untyped_storage().data_ptr() != whole.untyped_storage().data_ptr()
    assert torch.equal(part, whole[1])


def test_what_is_put_twice_stays_where_it_is() -> None:
    shelf, tensor = Shelf(), noise(3000)
    shelf.put([tensor])
    place = tensor.data_ptr()
    shelf.put([tensor])
    assert tensor.data_ptr() == place


@pytest.mark.parametrize(
    "tensor", [noise(10), noise(100, 100).T, noise(1).expand(5000)], ids=["small", "turned", "one"]
)
def test_what_does_not_fit_the_shelf_is_left_alone(tensor: torch.Tensor) -> None:
    place, strides = tensor.data_ptr(), tensor.stride()
    Shelf().put([None, tensor])
    assert (tensor.data_ptr(), tensor.stride()) == (place, strides)


def test_many_tensors_take_many_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shelf_module, "FIRST_BLOCK", 1 << 20)
    shelf = Shelf()
    tensors = [noise(100_000 + n) for n in range(40)]  # .4 MB each
    shelf.put(tensors)
    shelf.release()
    assert all(torch.equal(t, noise(len(t))) for t in tensors)


def test_an_array_is_kept() -> None:
    shelf, given = Shelf(), np.arange(5000.0).reshape(50, 100)
    kept = shelf.array(given)
    shelf.release()
    assert np.array_equal(kept, given) and kept.dtype == given.dtype
    assert not np.shares_memory(kept, given)


def test_a_full_disk_leaves_tensors_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    tensor = noise(5000)
    place = tensor.data_ptr()
    Shelf().put([tensor])
    assert tensor.data_ptr() == place and torch.equal(tensor, noise(5000))


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read as on Linux")
def test_release_gives_the_memory_back() -> None:
    shelf, tensor = Shelf(), noise(10_000_000)  # 40 MB
    shelf.put([tensor])
    total, read = float(tensor.sum()), resident()
    shelf.release()
    assert resident() < read - 30
    assert float(tensor.sum()) == total


@pytest.mark.skipif(sys.platform != "linux", reason="mappings are listed as on Linux")
def test_the_file_goes_with_the_last_tensor() -> None:
    def mapped() -> int:
        return Path("/proc/self/maps").read_text(encoding="utf-8").count("(deleted)")

    before, shelf, tensor = mapped(), Shelf(), noise(5000)
    shelf.put([tensor])
    assert mapped() == before + 1
    del shelf
    assert torch.equal(tensor, noise(5000))
    del tensor
    gc.collect()
    assert mapped() == before


@pytest.mark.parametrize("problem", [OSError, AttributeError])
def test_without_glibc_freed_memory_stays(monkeypatch: pytest.MonkeyPatch, problem: type) -> None:
    def no_library(name: None) -> None:
        raise problem

    monkeypatch.setattr(shelf_module.ctypes, "CDLL", no_library)
    give_back_freed()


def test_without_fallocate_the_block_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(shelf_module.os, "posix_fallocate", raising=False)
    monkeypatch.setattr(shelf_module, "FIRST_BLOCK", (1 << 20) + 7)
    shelf, tensor = Shelf(), noise(5000)
    shelf.put([tensor])
    assert shelf.holds(tensor) and torch.equal(tensor, noise(5000))
