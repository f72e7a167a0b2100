"""Trajectories in the TUM format: `timestamp tx ty tz qx qy qz qw`, camera to world."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from minislam.data.files import data_rows, finite_numbers, read_text, write_text
from minislam.errors import require
from minislam.records import Trajectory

_TRUTHS = ("groundtruth.txt", "pose.txt")  # TUM and Bonn; Wild-SLAM
_COLUMNS = "timestamp tx ty tz qx qy qz qw"

# Ground-truth files round to four decimals; farther off is not a rotation but a wrong column.
_QUATERNION_NORM_TOLERANCE = 0.05


def truth_beside(folder: Path) -> Path | None:
    """Return the file of the ground truth in the folder of a recording, if there is one."""
    return next((folder / name for name in _TRUTHS if (folder / name).is_file()), None)


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a TUM trajectory; of rows of one timestamp, as published truth has, keep the first."""
    rows: list[list[float]] = []
    for where, row in data_rows(read_text(path), str(path)):
        numbers = finite_numbers(row.split(), where)
        error = abs(math.hypot(*numbers[4:]) - 1)
        is_pose = len(numbers) == 8 and error <= _QUATERNION_NORM_TOLERANCE
        found = f"{len(numbers)}, '{row[:200]}', in {where}; check their number and order"
        require(is_pose, f"8 columns, {_COLUMNS}, the last four a unit quaternion", found)
        last = rows[-1][0] if rows else -math.inf
        found = f"{numbers[0]} after {last} in {where}; sort the file"
        require(numbers[0] >= last, "timestamps that increase", found)
        if numbers[0] > last:
            rows.append(numbers)
    require(bool(rows), f"rows of {_COLUMNS}", f"none in {path}; check the file")
    table = np.array(rows)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], poses)


def write_trajectory(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory file: 6 decimals of a second, 9 significant digits of the rest."""
    poses = np.asarray(trajectory.T_world_camera, dtype=np.float64).reshape(-1, 4, 4)
    stamps = np.round(trajectory.timestamps, 6)
    is_finite = np.isfinite(poses).all() and np.isfinite(stamps).all()
    wanted = "finite poses, and timestamps that increase by at least a microsecond"
    found = "others; leave out lost poses, and pass the timestamps of the source"
    require(bool(is_finite and (np.diff(stamps) > 0).all()), wanted, found)
    quats_xyzw = np.zeros((0, 4))
    if len(poses):
        quats_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    # Adding zero turns -0.0 into 0.0.
    values = np.concatenate([poses[:, :3, 3], quats_xyzw], axis=1) + 0.0
    rows = (" ".join(f"{value:.9g}" for value in row) for row in values)
    lines = [f"{stamp:.6f} {row}\n" for stamp, row in zip(stamps, rows, strict=True)]
    write_text(path, "".join([f"# {_COLUMNS}\n# second, world units, camera to world\n", *lines]))
