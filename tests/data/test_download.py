"""A file is fetched whole, in pieces, or not at all; a server on the loopback address gives it."""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from minislam.data import download as module
from minislam.data.download import download
from minislam.errors import InputError
from tests.loopback import serve

CONTENT = np.random.default_rng(0).bytes(1_000_000)
HASH = hashlib.sha256(CONTENT).hexdigest()


def has_right_hash(path: Path) -> None:
    if hashlib.sha256(path.read_bytes()).hexdigest() != HASH:
        raise InputError("expected the right hash, found another")


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serve({"/w.pth": CONTENT}) as (server, address):
        server.url = f"{address}/w.pth"
        yield server


def fetch(server, path: Path) -> list[tuple[int, int]]:
    shown: list[tuple[int, int]] = []
    download(server.url, path, has_right_hash, lambda done, total: shown.append((done, total)))
    return shown


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# Whole and in pieces


def test_a_whole_file_arrives_with_its_progress(server, tmp_path: Path):
    shown = fetch(server, tmp_path / "new/folder/w.pth")
    assert (tmp_path / "new/folder/w.pth").read_bytes() == CONTENT
    assert names(tmp_path / "new/folder") == ["w.pth"]
    assert shown[-1] == (1_000_000, 1_000_000) and len(shown) >= 4
    assert server.asked == [("/w.pth", None)]


def test_interrupted_twice_it_ends_with_the_right_hash(server, tmp_path: Path):
    path = tmp_path / "w.pth"
    server.breaks_after = [300_001, 200_002]
    for done in (300_001, 500_003):
        with pytest.raises(InputError, match=rf"ended after {done} of 1000000 bytes; the same com"):
            fetch(server, path)
        assert names(tmp_path) == ["w.pth.part"]
    shown = fetch(server, path)
    assert path.read_bytes() == CONTENT and names(tmp_path) == ["w.pth"]
    assert shown[0][0] > 500_003 and shown[-1] == (1_000_000, 1_000_000)
    assert [wanted for _, wanted in server.asked] == [None, "bytes=300001-", "bytes=500003-"]


def test_ctrl_c_keeps_what_is_there(server, tmp_path: Path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(server.url, tmp_path / "w.pth", has_right_hash, stop)
    assert 0 < (tmp_path / "w.pth.part").stat().st_size < len(CONTENT)
    fetch(server, tmp_path / "w.pth")
    assert (tmp_path / "w.pth").read_bytes() == CONTENT


def test_a_server_without_ranges_sends_all_of_it_again(server, tmp_path: Path):
    server.knows_ranges = False
    (tmp_path / "w.pth.part").write_bytes(b"x" * 400_000)
    fetch(server, tmp_path / "w.pth")
    assert (tmp_path / "w.pth").read_bytes() == CONTENT


def test_a_part_that_is_already_whole_only_takes_its_name(server, tmp_path: Path):
    (tmp_path / "w.pth.part").write_bytes(CONTENT)
    assert fetch(server, tmp_path / "w.pth") == [] and names(tmp_path) == ["w.pth"]


# Errors


def test_a_wrong_hash_leaves_nothing(server, tmp_path: Path):
    (tmp_path / "w.pth.part").write_bytes(b"not the beginning of it")
    with pytest.raises(InputError, match="found another; what was fetched is removed"):
        fetch(server, tmp_path / "w.pth")
    assert names(tmp_path) == []
    fetch(server, tmp_path / "w.pth")
    assert names(tmp_path) == ["w.pth"]


def test_no_such_file_no_such_server_and_no_folder_are_one_sentence(server, tmp_path: Path):
    server.files = {}
    (tmp_path / "other.pth").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"expected to fetch http://.*, but: .*404.*; the same"):
        fetch(server, tmp_path / "w.pth")
    server.url = "http://127.0.0.1:9/w.pth"
    with pytest.raises(InputError, match=r"but: .*(refused|unreachable|urlopen)"):
        fetch(server, tmp_path / "w.pth")
    with pytest.raises(InputError, match=r"but: .*(exists|directory)"):
        fetch(server, tmp_path / "other.pth/w.pth")
    assert names(tmp_path) == ["other.pth"] and (tmp_path / "other.pth").read_bytes() == b"mine"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device of Linux")
def test_a_full_disk_is_one_sentence(server, tmp_path: Path):
    (tmp_path / "w.pth.part").symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left on device; the same command goes on"):
        fetch(server, tmp_path / "w.pth")
    assert not (tmp_path / "w.pth").exists()


def test_a_disk_that_fills_up_later_keeps_what_was_written(server, tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module.os, "fsync", full)
        with pytest.raises(InputError, match="No space left"):
            fetch(server, tmp_path / "w.pth")
    assert names(tmp_path) == ["w.pth.part"]
    fetch(server, tmp_path / "w.pth")
    assert (tmp_path / "w.pth").read_bytes() == CONTENT


def test_the_progress_tells_the_whole_length_from_the_start(server, tmp_path: Path):
    assert {total for _, total in fetch(server, tmp_path / "w.pth")} == {1_000_000}
