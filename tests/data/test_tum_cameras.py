"""Facts about benchmarks that their folders do not state."""

import numpy as np
import pytest

from minislam.data.tum import bonn_camera_trajectory, known_camera, read_tum_folder
from minislam.records import Trajectory
from tests.helpers import random_transforms
from tests.recordings import tum_folder

# Known answers


@pytest.mark.parametrize(
    "text, camera",
    [
        ("rgbd_dataset_freiburg1_desk", "fr1"),
        ("fr2_desk", "fr2"),
        ("Freiburg3 walking_xyz", "fr3"),
        ("tum_fr3", "fr3"),
        ("africa_fr10", None),
        ("suffr1ce", None),
        ("freiburg", None),
        ("carbonn", None),
    ],
)
def test_tum_cameras_are_known_by_name(text: str, camera: str | None):
    found = known_camera(text)
    assert (found and found.origin) == (camera and f"TUM {camera} intrinsics")


def test_fr3_has_no_distortion_and_fr1_has():
    assert not np.any(known_camera("fr3").distortion.coefficients)
    assert known_camera("fr1").distortion.k1 == 0.2624


@pytest.mark.parametrize("name", ["rgbd_bonn_crowd", "renamed"])
def test_a_bonn_folder_has_camera_and_corrected_truth(tmp_path, name: str):
    folder = tum_folder(tmp_path / name, size=(64, 48))
    rows = (folder / "rgb.txt").read_text()
    (folder / "rgb.txt").write_text(f"# file: 'rgbd_bonn_crowd.bag'\n{rows}")
    (folder / "calibration.txt").unlink()
    recording = read_tum_folder(folder)
    assert recording.calibration.origin == "Bonn intrinsics"
    # The first marker pose is the identity: the camera sits where the makers measured it, with
    # the axes of ROS (-x, z, y) undone twice: T_ros T_ros T_m = T_m.
    np.testing.assert_allclose(
        recording.trajectory.T_world_camera[0, :3, 3], [0.0113, -0.0098, 0.0111], atol=1e-12
    )


# Identities


def test_bonn_poses_are_rigid_and_move_like_the_markers():
    markers = Trajectory(np.arange(5.0), random_transforms(5, "normal", 0).numpy())
    cameras = bonn_camera_trajectory(markers)
    rotations = cameras.T_world_camera[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), (5, 3, 3))
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    # The camera stays within two centimetres of the marker plate, in the turned world (-x, z, y).
    plate = markers.T_world_camera[:, [0, 2, 1], 3] * [-1, 1, 1]
    distance = np.linalg.norm(cameras.T_world_camera[:, :3, 3] - plate, axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm([0.0113, 0.0098, 0.0111]), atol=1e-12)
