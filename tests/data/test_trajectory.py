"""TUM trajectory files: byte format, round trip, and every way they can be wrong."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from minislam.data.trajectory import (
    read_trajectory,
    write_trajectory,
)
from minislam.errors import InputError
from minislam.records import Trajectory
from tests.helpers import random_transforms


def read_text(text: str, folder: Path) -> Trajectory:
    (folder / "gt.txt").write_text(text)
    return read_trajectory(folder / "gt.txt")


def text_of(trajectory: Trajectory, folder: Path) -> str:
    write_trajectory(folder / "t.txt", trajectory)
    return (folder / "t.txt").read_text()


def random_trajectory(count: int, seed: int = 0) -> Trajectory:
    stamps = 1305031102.160407 + np.arange(count) / 30
    return Trajectory(stamps, random_transforms(count, "normal", seed).numpy())


# Known answers


def test_a_row_is_camera_to_world_with_the_scalar_last(tmp_path: Path):
    # A quarter turn about z: qz = qw = sqrt(1/2).
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [1, -0.0, 1 / 3]
    text = text_of(Trajectory(np.array([1 / 30]), T[None]), tmp_path)
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    assert rows == ["0.033333 1 0 0.333333333 0 0 0.707106781 0.707106781"]
    parsed = read_text(rows[0], tmp_path)
    np.testing.assert_allclose(parsed.T_world_camera[0], T, atol=1e-9)


def test_header_byte_order_mark_and_windows_line_ends(tmp_path: Path):
    path = tmp_path / "gt.txt"
    path.write_bytes(
        b"\xef\xbb\xbf# timestamp tx ...\r\n1.0 0 0 0 0 0 0 1 \r\n\r\n2.0 1 0 0 0 0 0 1"
    )
    read = read_trajectory(path)
    np.testing.assert_array_equal(read.timestamps, [1, 2])
    np.testing.assert_array_equal(read.T_world_camera[1, :3, 3], [1, 0, 0])


def test_of_equal_timestamps_the_first_row_is_kept(tmp_path: Path):
    parsed = read_text("1 5 0 0 0 0 0 1\n1 6 0 0 0 0 0 1\n2 7 0 0 0 0 0 1\n", tmp_path)
    np.testing.assert_array_equal(parsed.T_world_camera[:, 0, 3], [5, 7])


def test_rounded_quaternions_become_rotations(tmp_path: Path):
    parsed = read_text("1 0 0 0 0.6453 -0.5498 0.3363 -0.4101", tmp_path)
    rotation = parsed.T_world_camera[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


# Identities


@pytest.mark.parametrize("count", [0, 1, 50])
def test_round_trip(tmp_path: Path, count: int):
    written = random_trajectory(count)
    write_trajectory(tmp_path / "t.txt", written)
    if count == 0:
        with pytest.raises(InputError, match="found none"):
            read_trajectory(tmp_path / "t.txt")
        return
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read.timestamps, written.timestamps, atol=1e-6)
    np.testing.assert_allclose(read.T_world_camera, written.T_world_camera, atol=1e-8)


def test_tiny_worlds_keep_their_digits(tmp_path: Path):
    tiny = random_trajectory(5)
    tiny.T_world_camera[:, :3, 3] *= 1e-9
    write_trajectory(tmp_path / "t.txt", tiny)
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(
        read.T_world_camera[:, :3, 3], tiny.T_world_camera[:, :3, 3], rtol=1e-7
    )


def test_no_row_ends_in_a_space(tmp_path: Path):
    text = text_of(random_trajectory(3), tmp_path)
    assert all(line == line.rstrip() for line in text.split("\n"))
    assert text.endswith("\n")


def test_evo_reads_what_is_written(tmp_path: Path):
    pytest.importorskip("evo")
    file_interface = importlib.import_module("evo.tools.file_interface")
    written = random_trajectory(20)
    write_trajectory(tmp_path / "t.txt", written)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(np.array(read.poses_se3), written.T_world_camera, atol=1e-8)


# Errors


@pytest.mark.parametrize(
    "row, message",
    [
        ("2 0 0 0 0 0 1", "8 columns.*found 7, .* in line 2 of .*gt.txt"),
        ("2 0 0 0 0 0 0 1 9", "found 9"),
        ("2,0,0,0,0,0,0,1", "finite numbers.*found '2,0"),
        ("2 0 0 nan 0 0 0 1", "finite numbers in line 2 of .*gt.txt"),
        ("2 0 0 x 0 0 0 1", "finite"),
        ("2 0 0 0 0 0 0 0", "unit quaternion"),
        ("2 0 0 0 1e200 0 0 1e200", "unit quaternion"),
        ("2 0 0 0 0 0 0 1.2", "unit quaternion"),
        ("0.5 0 0 0 0 0 0 1", "increase.*line 2 of .*gt.txt"),
    ],
)
def test_wrong_rows_are_named(row: str, message: str, tmp_path: Path):
    with pytest.raises(InputError, match=message):
        read_text("1 0 0 0 0 0 0 1\n" + row + "\n", tmp_path)


def test_what_cannot_be_read_back_is_not_written(tmp_path: Path):
    trajectory = random_trajectory(3)
    trajectory.T_world_camera[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="finite"):
        write_trajectory(tmp_path / "t.txt", trajectory)
    stamps = np.array([1.0, 1.0 + 1e-8, 2.0])
    with pytest.raises(InputError, match="microsecond"):
        write_trajectory(
            tmp_path / "t.txt", Trajectory(stamps, random_trajectory(3).T_world_camera)
        )
    assert not list(tmp_path.iterdir())
