"""Cameras and pose conventions of known benchmarks, which their folders do not state."""

import re

import numpy as np

from minislam.data.calibration import Calibration
from minislam.geometry import BrownDistortion
from minislam.records import Trajectory

_SIZE = (640, 480)  # px, all cameras below

# Intrinsics given by the makers of the TUM RGB-D benchmark (Sturm et al., IROS 2012).
_TUM_CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3, BrownDistortion(0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (520.9, 521.0, 325.1, 249.7, BrownDistortion(0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (535.4, 539.2, 320.1, 247.6, BrownDistortion()),
}
# Intrinsics given by the makers of the Bonn RGB-D Dynamic Dataset (Palazzolo et al., IROS 2019).
_BONN_CAMERA = (
    542.822841, 542.576870, 315.593520, 237.756098,
    BrownDistortion(0.039903, -0.099343, -0.000730, -0.000144),
)  # fmt: skip

# Bonn's ground truth is the pose of a plate of markers in the axes of ROS. The makers give the
# camera in the frame of the plate; its block is a rotation only up to a few per cent.
_BONN_T_marker_camera = np.array([
    [ 1.0157,  0.1828, -0.2389,  0.0113],
    [ 0.0009, -0.8431, -0.6413, -0.0098],
    [-0.3009,  0.6147, -0.8085,  0.0111],
    [ 0.0,     0.0,     0.0,     1.0   ],
])  # fmt: skip
_BONN_T_ros = np.array([
    [-1.0, 0.0, 0.0, 0.0],
    [ 0.0, 0.0, 1.0, 0.0],
    [ 0.0, 1.0, 0.0, 0.0],
    [ 0.0, 0.0, 0.0, 1.0],
])  # fmt: skip

_TUM_NAME = re.compile(r"(?<![a-z])(?:freiburg|fr)[_ -]?([123])(?!\d)", re.IGNORECASE)
_BONN_NAME = re.compile(r"(?<![a-z])rgbd_bonn(?![a-z])", re.IGNORECASE)


def known_camera(text: str) -> Calibration | None:
    """Return the intrinsics of the camera that a text names: freiburg1, fr3, rgbd_bonn."""
    tum = _TUM_NAME.search(text)
    if tum is None and not is_bonn(text):
        return None
    fx, fy, cx, cy, distortion = _TUM_CAMERAS[tum[1]] if tum else _BONN_CAMERA
    origin = f"TUM fr{tum[1]} intrinsics" if tum else "Bonn intrinsics"
    return Calibration(fx, fy, cx, cy, _SIZE, distortion, origin)


def is_bonn(text: str) -> bool:
    """Tell whether a name is that of a sequence of the Bonn RGB-D Dynamic Dataset."""
    return _BONN_NAME.search(text) is not None


def bonn_camera_trajectory(markers: Trajectory) -> Trajectory:
    """Return the camera's poses from the published poses of Bonn's marker plate."""
    poses = _BONN_T_ros @ markers.T_world_camera @ _BONN_T_ros @ _BONN_T_marker_camera
    # The nearest rotation to each block: what follows relies on poses being rigid.
    u, _, v_transposed = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ v_transposed
    return Trajectory(markers.timestamps, poses)
