"""Trajectories in the TUM format: `timestamp tx ty tz qx qy qz qw`, camera to world."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from minislam.data.files import data_rows, finite_numbers, read_text, write_text
from minislam.errors import InputError
from minislam.records import Trajectory

_TRUTHS = ("groundtruth.txt", "pose.txt")  # TUM and Bonn; Wild-SLAM
_COLUMNS = "timestamp tx ty tz qx qy qz qw"

# Ground-truth files round to four decimals; farther off is not a rotation but a wrong column.
_QUATERNION_NORM_TOLERANCE = 0.05


def truth_beside(folder: Path) -> Path | None:
    """Return the file of the ground truth in the folder of a recording, if there is one."""
    return next((folder / name for name in _TRUTHS if (folder / name).is_file()), None)


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a TUM trajectory file.

    Of rows with the same timestamp the first is kept: published ground truth has such rows.
    """
    rows: list[list[float]] = []
    for where, row in data_rows(read_text(path), str(path)):
        numbers = finite_numbers(row.split(), where)
        error = abs(math.hypot(*numbers[4:]) - 1)
        if len(numbers) != 8 or error > _QUATERNION_NORM_TOLERANCE:
            raise InputError(
                f"expected 8 columns, {_COLUMNS}, the last four a unit quaternion, found "
                f"{len(numbers)}, '{row[:200]}', in {where}; check their number and order"
            )
        if rows and numbers[0] < rows[-1][0]:
            raise InputError(
                f"expected timestamps that increase, found {numbers[0]} after {rows[-1][0]} in "
                f"{where}; sort the file"
            )
        if not rows or numbers[0] > rows[-1][0]:
            rows.append(numbers)
    if not rows:
        raise InputError(f"expected rows of {_COLUMNS}, found none in {path}; check the file")
    table = np.array(rows)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], poses)


def write_trajectory(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory file: 6 decimals of a second, 9 significant digits of the rest.

    An empty trajectory gives a file with the header only.
    """
    poses = np.asarray(trajectory.T_world_camera, dtype=np.float64).reshape(-1, 4, 4)
    stamps = np.round(trajectory.timestamps, 6)
    is_finite = np.isfinite(poses).all() and np.isfinite(stamps).all()
    if not is_finite or np.any(np.diff(stamps) <= 0):
        raise InputError(
            "expected finite poses, and timestamps that increase by at least a microsecond, found "
            "others; leave out lost poses, and pass the timestamps of the source"
        )
    quats_xyzw = np.zeros((0, 4))
    if len(poses):
        quats_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    # Adding zero turns -0.0 into 0.0.
    values = np.concatenate([poses[:, :3, 3], quats_xyzw], axis=1) + 0.0
    rows = (" ".join(f"{value:.9g}" for value in row) for row in values)
    lines = [f"{stamp:.6f} {row}\n" for stamp, row in zip(stamps, rows, strict=True)]
    write_text(path, "".join([f"# {_COLUMNS}\n# second, world units, camera to world\n", *lines]))
