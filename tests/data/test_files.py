"""Files are written whole or not at all, and unreadable ones give one sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from minislam.data import files
from minislam.data.files import (
    atomic_write,
    data_rows,
    finite_numbers,
    make_folder,
    read_bytes,
    read_json,
    read_text,
    require_new,
    write_json,
)
from minislam.errors import InputError

# Known answers


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path):
    path = tmp_path / "map.ply"
    atomic_write(path, b"old")
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_json_has_no_nan(tmp_path: Path):
    write_json(tmp_path / "m.json", {"psnr": float("inf"), "list": [1, float("nan")], "name": "ä"})
    assert read_json(tmp_path / "m.json") == {"psnr": None, "list": [1, None], "name": "ä"}


def test_rows_skip_comments_and_blank_lines_but_keep_their_numbers():
    assert data_rows("# head\r\n\r\n 1 2 \r\n#x\n3\n", "a") == [
        ("line 3 of a", "1 2"),
        ("line 5 of a", "3"),
    ]


def test_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path: Path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1 2\r\n3 4\r\n")
    assert [row for _, row in data_rows(read_text(tmp_path / "a.txt"), "a")] == ["1 2", "3 4"]


# A crash between the two steps


@pytest.mark.slow
def test_a_writer_killed_before_the_exchange_leaves_the_old_file(tmp_path: Path):
    path = tmp_path / "trajectory.txt"
    path.write_bytes(b"old")
    program = (
        "import os, sys\n"
        "from minislam.data import files\n"
        "os.replace = lambda *_: os._exit(9)\n"
        "files.atomic_write(sys.argv[1], b'new' * 1000)\n"
    )
    root = Path(files.__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    ended = subprocess.run([sys.executable, "-c", program, str(path)], env=environment)
    assert ended.returncode == 9
    assert path.read_bytes() == b"old"
    atomic_write(path, b"newer")  # what the dead writer left is no obstacle
    assert path.read_bytes() == b"newer"


def test_a_link_stays_a_link_and_a_device_stays_a_device(tmp_path: Path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to("target")
    atomic_write(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "target").read_bytes() == b"new"
    os.mkfifo(tmp_path / "pipe")
    for special in (tmp_path / "pipe", Path(os.devnull), tmp_path):
        with pytest.raises(InputError, match=r"but .* is none; choose another name"):
            atomic_write(special, b"new")
    assert (tmp_path / "pipe").is_fifo() and not Path(os.devnull).is_file()


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path):
    with files.atomic_file(tmp_path / "a") as first:
        first.write(b"first")
        atomic_write(tmp_path / "a", b"second")
    assert (tmp_path / "a").read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_a_name_that_is_no_utf_8_comes_back_from_json(tmp_path: Path):
    name = os.fsdecode(b"bad\xff")
    write_json(tmp_path / "a.json", {"command": [name]})
    assert read_json(tmp_path / "a.json")["command"] == [name]


def test_a_failed_exchange_leaves_no_temporary_file(tmp_path: Path, monkeypatch):
    path = tmp_path / "trajectory.txt"
    path.write_bytes(b"old")

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.os, "replace", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


# Errors


def test_writing_where_there_is_no_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="be able to write"):
        atomic_write(tmp_path / "missing" / "a.txt", b"")


def test_a_folder_is_made_or_the_reason_is_said(tmp_path: Path, monkeypatch):
    make_folder(tmp_path / "a/b")
    make_folder(tmp_path / "a/b")
    assert (tmp_path / "a/b").is_dir()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="file is a file; choose another name"):
        make_folder(tmp_path / "file/a")
    with pytest.raises(InputError, match=r"expected to make the folder .* says: .*; choose"):
        make_folder(tmp_path / ("a" * 300))


def test_only_new_files_are_written_unless_asked_and_inputs_never(tmp_path: Path, monkeypatch):
    old, new, link = (tmp_path / name for name in ("old", "new", "link"))
    old.write_text("mine")
    link.symlink_to("old")
    require_new([None, new, ""], False, [old, tmp_path / "nowhere"])
    require_new([old], True, [new])
    require_new([link], True, [new])
    with pytest.raises(InputError, match=r"of different names, found .*old twice"):
        require_new([new, old, link], True, [])
    with pytest.raises(InputError, match="old exists; choose another name or add --overwrite"):
        require_new([new, old], False, [])
    for overwrite in (True, False):
        with pytest.raises(InputError, match="link exists and is an input"):
            require_new([link], overwrite, [old])
    with pytest.raises(InputError, match="nowhere is no writable folder"):
        require_new([tmp_path / "nowhere/a"], True, [])
    monkeypatch.setattr(files.os, "access", lambda path, mode: False)
    with pytest.raises(InputError, match="is no writable folder; make it, or choose another"):
        require_new([new], True, [])


def test_missing_and_binary_files_are_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"nothing\.txt"):
        read_bytes(tmp_path / "nothing.txt")
    with pytest.raises(InputError, match="check the path"):
        read_bytes("a\0b")
    (tmp_path / "b.txt").write_bytes(b"1 2 \xff\xfe")
    with pytest.raises(InputError, match=r"byte 4 of .*b\.txt"):
        read_text(tmp_path / "b.txt")


def test_broken_json_is_named(tmp_path: Path):
    (tmp_path / "c.json").write_text('{"a": 1,}')
    with pytest.raises(InputError, match=r"c\.json.*line 1.*; correct it"):
        read_json(tmp_path / "c.json")
    (tmp_path / "c.json").write_text('{"seed": ' + "9" * 5000 + "}")
    with pytest.raises(InputError, match=r"c\.json.*digits"):
        read_json(tmp_path / "c.json")


def test_a_comma_is_an_advice_about_points_only_in_a_line_of_numbers():
    with pytest.raises(InputError, match="separate columns by spaces, and write decimal points"):
        finite_numbers(["-1,5e3,2", "3.5"], "line 4 of x")
    for fields in (["timestamp,x,y"], ["1,5", "nan"], ["none"]):
        with pytest.raises(InputError, match="; correct it"):
            finite_numbers(fields, "line 4 of x")


@pytest.mark.parametrize("field", ["nan", "inf", "-Infinity", "1e999", "abc", "0x10", "1,5"])
def test_only_finite_numbers_pass(field: str):
    with pytest.raises(InputError, match="line 4 of x"):
        finite_numbers(["1", field], "line 4 of x")
