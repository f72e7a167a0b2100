"""Tensors on the shelf, whose memory is given back and nobody notices; the peak of a process."""

import errno
import gc
import mmap
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.state import memory
from minislam.state.memory import Shelf, give_back_freed, peak_memory_mb, release, stack


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
    release()
    assert other.dtype == dtype and torch.equal(other, wanted)


def test_the_layout_stays_that_of_a_tensor_in_memory() -> None:
    shelf = Shelf()
    tensors = [noise(1000 + odd, 3) for odd in range(3)]
    shelf.put(tensors)
    assert [t.data_ptr() % memory.ALIGNMENT for t in tensors] == [0, 0, 0]
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


def test_rows_are_copies_that_let_the_whole_go() -> None:
    whole, shelf = noise(6, 2000), Shelf()
    rows = shelf.rows(whole)
    assert all(torch.equal(row, one) for row, one in zip(rows, whole, strict=True))
    assert all(shelf.holds(row) and row._base is None for row in rows)


def test_many_tensors_take_many_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "FIRST_BLOCK", 1 << 20)
    shelf = Shelf()
    tensors = [noise(100_000 + n) for n in range(40)]  # .4 MB each
    shelf.put(tensors)
    release()
    assert all(torch.equal(t, noise(len(t))) for t in tensors)


def test_the_place_of_a_tensor_that_is_gone_is_taken_again() -> None:
    shelf, tensor, other = Shelf(), noise(5000), noise(6000)
    shelf.put([tensor, other])
    place, view = tensor.data_ptr(), tensor[1:]
    del tensor
    shelf.put([second := noise(5000)])
    assert second.data_ptr() != place  # a view still needs it
    del view
    shelf.put([third := noise(5000)])
    assert third.data_ptr() == place
    assert torch.equal(third, noise(5000)) and torch.equal(other, noise(6000))


def test_an_array_is_kept() -> None:
    shelf, given = Shelf(), np.arange(5000.0).reshape(50, 100)
    kept = shelf.array(given)
    release()
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
    release()
    assert resident() < read - 30
    assert float(tensor.sum()) == total


@pytest.mark.parametrize("count", [10, 2000])
def test_a_stack_has_the_rows_in_their_order(count: int) -> None:
    rows = [noise(3000) + index for index in range(count)]
    found = stack([rows[0].expand(3, 3000), *(row.expand(3, 3000) for row in rows[1:])])
    assert found.shape == (count, 3, 3000) and found.is_contiguous()
    assert all(torch.equal(one, row.expand(3, 3000)) for one, row in zip(found, rows, strict=True))


def test_without_room_on_the_disk_a_large_stack_is_in_memory(monkeypatch: pytest.MonkeyPatch):
    def full(length: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(memory, "_block", full)
    assert stack([noise(3_000_000)] * 2).equal(noise(3_000_000).expand(2, -1))


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read as on Linux")
def test_a_large_stack_is_not_in_memory() -> None:
    rows, before = [noise(500_000)] * 40, resident()  # 80 MB stacked
    found = stack(rows)
    assert resident() < before + 10
    found *= 2
    assert resident() > before + 60
    release()
    assert resident() < before + 10 and torch.equal(found[39], 2 * rows[0])


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read as on Linux")
def test_what_is_put_is_no_longer_in_memory() -> None:
    shelf, before = Shelf(), resident()
    pages = mmap.mmap(-1, 40_000_000)  # new ones: what other tests have freed may be resident
    tensor = torch.frombuffer(pages, dtype=torch.float32).fill_(0.5)
    del pages
    assert resident() > before + 30
    shelf.put([tensor])
    assert resident() < before + 10


@pytest.mark.skipif(sys.platform != "linux", reason="mappings are listed as on Linux")
def test_the_file_goes_with_the_last_tensor() -> None:
    def mapped() -> int:
        return Path("/proc/self/maps").read_text(encoding="utf-8").count("(deleted)")

    gc.collect()  # what earlier tests left in cycles
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

    monkeypatch.setattr(memory.ctypes, "CDLL", no_library)
    give_back_freed()


def test_without_fallocate_the_block_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(memory.os, "posix_fallocate", raising=False)
    monkeypatch.setattr(memory, "FIRST_BLOCK", (1 << 20) + 7)
    shelf, tensor = Shelf(), noise(5000)
    shelf.put([tensor])
    assert shelf.holds(tensor) and torch.equal(tensor, noise(5000))


def test_peak_memory_is_in_megabytes(monkeypatch: pytest.MonkeyPatch):
    on_linux = peak_memory_mb()
    assert 30 < on_linux < 30_000
    monkeypatch.setattr(sys, "platform", "darwin")  # there the system counts bytes
    assert peak_memory_mb() == pytest.approx(on_linux / 1024, rel=0.1)


@pytest.mark.slow
def test_the_memory_of_the_process_that_starts_a_run_is_not_counted():
    child = "from minislam.state.memory import peak_memory_mb; print(peak_memory_mb() or 0)"
    parent = (
        "import subprocess, sys\nlarge = bytearray(b'1') * 900_000_000\n"
        f"subprocess.run([sys.executable, '-c', {child!r}])"
    )
    done = subprocess.run([sys.executable, "-c", parent], capture_output=True, text=True)
    assert float(done.stdout) < 800, done.stderr


@pytest.mark.slow
def test_without_the_counter_of_unix_the_package_still_imports():
    program = (
        "import sys; sys.modules['resource'] = None\n"
        "import minislam.runs.api; from minislam.state.memory import peak_memory_mb\n"
        "print(peak_memory_mb())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "None\n", done.stderr
