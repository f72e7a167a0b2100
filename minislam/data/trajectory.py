"""Trajectories in the TUM format: `timestamp tx ty tz qx qy qz qw`, camera to world."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from minislam.data.files import data_rows, finite_numbers, read_text, write_text
from minislam.errors import InputError
from minislam.records import Trajectory

_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_HEADER = f"# {_COLUMNS}\n# second, world units, camera to world\n"

# Ground-truth files round to four decimals; farther off is not a rotation but a wrong column.
_QUATERNION_NORM_TOLERANCE = 0.05


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a TUM trajectory file."""
    return parse_trajectory(read_text(path), str(path))


def parse_trajectory(text: str, name: str) -> Trajectory:
    """Parse the content of a TUM trajectory file; `name` goes into the errors.

    Of rows with the same timestamp the first is kept: published ground truth has such rows.
    """
    rows: list[list[float]] = []
    for number, row in data_rows(text):
        where = f"line {number} of {name}"
        fields = row.split()
        if len(fields) != 8:
            raise InputError(
                f"expected 8 columns, {_COLUMNS}, found {len(fields)} in {where}; correct this line"
            )
        numbers = finite_numbers(fields, where)
        if not abs(math.hypot(*numbers[4:]) - 1) <= _QUATERNION_NORM_TOLERANCE:
            raise InputError(
                f"expected a unit quaternion qx qy qz qw, found {' '.join(fields[4:])} in {where}; "
                "check the order of the columns"
            )
        if rows and numbers[0] < rows[-1][0]:
            raise InputError(
                f"expected timestamps that increase, found {fields[0]} after {rows[-1][0]} in "
                f"{where}; sort the file"
            )
        if not rows or numbers[0] > rows[-1][0]:
            rows.append(numbers)
    if not rows:
        raise InputError(f"expected rows of {_COLUMNS}, found none in {name}; check the file")
    table = np.array(rows)
    return Trajectory(table[:, 0], poses_from_tum(table[:, 1:4], table[:, 4:]))


def write_trajectory(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory file; an empty trajectory gives a file with the header only."""
    write_text(path, format_trajectory(trajectory))


def format_trajectory(trajectory: Trajectory) -> str:
    """Return the text of a TUM file: 6 decimals of a second, 9 significant digits of the rest."""
    poses = np.asarray(trajectory.T_world_camera, dtype=np.float64).reshape(-1, 4, 4)
    stamps = [f"{stamp:.6f}" for stamp in trajectory.timestamps]
    if not (np.isfinite(poses).all() and np.isfinite(trajectory.timestamps).all()):
        raise InputError(
            "expected a finite trajectory, found NaN or infinity; leave out lost poses"
        )
    if np.any(np.diff(np.array(stamps, dtype=np.float64)) <= 0):
        raise InputError(
            "expected timestamps that increase by at least a microsecond, found equal or falling "
            "ones; pass the timestamps of the source"
        )
    if len(poses) == 0:
        return _HEADER
    quats_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    # Adding zero turns -0.0 into 0.0.
    values = np.concatenate([poses[:, :3, 3], quats_xyzw], axis=1) + 0.0
    rows = (" ".join(f"{value:.9g}" for value in row) for row in values)
    return _HEADER + "".join(f"{stamp} {row}\n" for stamp, row in zip(stamps, rows, strict=True))


def poses_from_tum(
    positions: np.ndarray,  # (N, 3) world units, camera centres
    quats_xyzw: np.ndarray,  # (N, 4) scalar last, as TUM files have it
) -> np.ndarray:  # (N, 4, 4) T_world_camera
    """Assemble poses from positions and quaternions."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quats_xyzw).as_matrix()
    poses[:, :3, 3] = positions
    return poses
