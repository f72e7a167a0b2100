"""Checkpoint files: what goes in comes out, a half-written one never stands there."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.data import files
from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.errors import InputError


def round_trip(tree: object, folder: Path) -> object:
    write_checkpoint(folder / "checkpoint.npz", tree)
    return read_checkpoint(folder / "checkpoint.npz")


# Known answers


def test_plain_values_come_back_exactly(tmp_path: Path):
    plain = {"a": [1, 0.1 + 0.2, None, True, "words", {}], "b": {"7": []}, "@": 1e-320}
    assert round_trip(plain, tmp_path) == plain
    assert math.isnan(round_trip([math.nan], tmp_path)[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.uint8])
@pytest.mark.parametrize("shape", [(), (0, 3), (1,), (2, 3, 4)])
def test_tensors_come_back_exactly(dtype: torch.dtype, shape: tuple[int, ...], tmp_path: Path):
    values = torch.arange(math.prod(shape)).reshape(shape).to(dtype)
    again = round_trip({"deep": [values, values > 2]}, tmp_path)["deep"]
    assert again[0].dtype == dtype and torch.equal(again[0], values)
    assert torch.equal(again[1], values > 2)


def test_arrays_stay_arrays_and_can_be_found_by_their_path(tmp_path: Path):
    gray = np.arange(6, dtype=np.uint8).reshape(2, 3)
    again = round_trip({"chain": [{"gray": gray}]}, tmp_path)["chain"][0]["gray"]
    assert isinstance(again, np.ndarray)
    np.testing.assert_array_equal(again, gray)
    with np.load(tmp_path / "checkpoint.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["chain/0/gray"], gray)


def test_the_order_in_memory_comes_back(tmp_path: Path):
    # A sum adds up in the order of memory, so another order is another last bit.
    values = torch.arange(24.0).reshape(2, 3, 4)
    kinds = [
        values.mT,
        values[:, 1:, ::2],
        values[..., :1].expand(2, 3, 5),
        torch.zeros(()).expand(3),
    ]
    for before, after in zip(kinds, round_trip(kinds, tmp_path), strict=True):
        assert after.stride() == before.stride() and torch.equal(after, before)


def test_what_is_one_tensor_stays_one_and_is_stored_once(tmp_path: Path):
    large = torch.ones(100_000)
    again = round_trip([large, {"same": large}, large.clone()], tmp_path)
    assert again[0] is again[1]["same"] and again[2] is not again[0]
    assert 2 * 400_000 < (tmp_path / "checkpoint.npz").stat().st_size < 2 * 400_000 + 5000


def test_what_was_written_on_a_gpu_is_read_without_one(tmp_path: Path):
    path = tmp_path / "checkpoint.npz"
    values = torch.arange(6.0).reshape(2, 3)
    write_checkpoint(path, {"values": values.T})
    with np.load(path) as file:
        arrays = dict(file)
    text = arrays["tree.json"].tobytes().replace(b'"cpu"', b'"cuda:0"')
    np.savez(path, **arrays | {"tree.json": np.frombuffer(text, np.uint8)})
    again = read_checkpoint(path)["values"]
    assert again.device.type == "cpu" and torch.equal(again, values.T)
    assert read_checkpoint(path, "meta")["values"].device.type == "meta"


# Errors


def test_a_failed_write_leaves_the_old_one(tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    write_checkpoint(tmp_path / "checkpoint.npz", {"frame": 1})
    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(InputError, match=r"checkpoint\.npz.*No space left"):
        write_checkpoint(tmp_path / "checkpoint.npz", {"frame": 2})
    assert read_checkpoint(tmp_path / "checkpoint.npz") == {"frame": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.npz"]


def test_an_interruption_while_writing_leaves_the_old_one(tmp_path: Path, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    write_checkpoint(tmp_path / "checkpoint.npz", {"frame": 1})
    monkeypatch.setattr(np, "savez", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(tmp_path / "checkpoint.npz", {"frame": 2})
    assert read_checkpoint(tmp_path / "checkpoint.npz") == {"frame": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.npz"]


@pytest.mark.parametrize("kept", [0, 10, 1000, -1])
def test_a_damaged_file_is_one_sentence(kept: int, tmp_path: Path):
    path = tmp_path / "checkpoint.npz"
    write_checkpoint(path, {"values": torch.arange(1000.0)})
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"checkpoint\.npz, found a damaged or another file"):
        read_checkpoint(path)


def test_a_flipped_bit_is_noticed(tmp_path: Path):
    path = tmp_path / "checkpoint.npz"
    write_checkpoint(path, {"values": torch.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(path)


class RunsCode:
    """What a pickle of it does when it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_of_another_program_and_one_that_would_run_code_are_refused(tmp_path: Path):
    path = tmp_path / "checkpoint.npz"
    np.savez(path, values=np.zeros(3))
    with pytest.raises(InputError, match="found a damaged or another file"):
        read_checkpoint(path)
    np.savez(path, **{"tree.json": np.array([RunsCode(tmp_path / "done")])})  # a pickle
    with pytest.raises(InputError, match="found a damaged or another file"):
        read_checkpoint(path)
    assert not (tmp_path / "done").exists()
    with pytest.raises(InputError, match="a readable file"):
        read_checkpoint(tmp_path / "none.npz")
