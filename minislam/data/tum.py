"""TUM RGB-D folders, their known cameras, and the truth that synthetic sequences add to them."""

import os
import re
from pathlib import Path

import numpy as np

from minislam.data import sources
from minislam.data.calibration import Calibration, calibration_beside
from minislam.data.files import data_rows, finite_numbers, read_bytes, read_text
from minislam.data.images import list_images
from minislam.data.metadata import noted_size
from minislam.data.raw_images import FileImages
from minislam.data.trajectory import read_trajectory, truth_beside
from minislam.errors import require
from minislam.geometry import BrownDistortion
from minislam.records import Trajectory

_DEPTH_MAX_DIFFERENCE = 0.02  # second between a colour and its depth image, as TUM's associate.py

# Intrinsics and distortion of images of 640x480 px, given by the makers of the TUM RGB-D benchmark
# (Sturm et al., IROS 2012) and of the Bonn RGB-D Dynamic Dataset (Palazzolo et al., IROS 2019).
_CAMERAS = {
    "TUM fr1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "TUM fr2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "TUM fr3": ((535.4, 539.2, 320.1, 247.6), ()),
    "Bonn": (
        (542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.000730, -0.000144),
    ),
}
_NAMES = re.compile(r"(?i)(?<![a-z])((?:freiburg|fr)[_ -]?([123])(?!\d)|rgbd_bonn(?![a-z]))")

# Bonn's ground truth is the pose of a plate of markers in the axes of ROS. The makers give the
# camera in the frame of the plate; its block is a rotation only up to a few per cent.
_BONN_T_marker_camera = np.array([
    [ 1.0157,  0.1828, -0.2389,  0.0113],
    [ 0.0009, -0.8431, -0.6413, -0.0098],
    [-0.3009,  0.6147, -0.8085,  0.0111],
    [ 0.0,     0.0,     0.0,     1.0   ],
])  # fmt: skip
_BONN_T_ros = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def is_tum_folder(folder: Path) -> bool:
    """Tell by the content: a list rgb.txt, or rgb/ with file names that are times in seconds."""
    if (folder / "rgb.txt").is_file():
        return True
    images = list_images(folder / "rgb")
    return bool(images) and all(re.fullmatch(r"\d+\.\d+", path.stem) for path in images)


def read_tum_folder(folder: Path) -> sources.Recording:
    """Read a TUM RGB-D folder; everything but the colour images is optional."""
    stamps, paths = _images(folder, "rgb")
    require(len(paths) > 0, f"images in {folder}/rgb.txt", "none; check the list")
    depth_stamps, depths = _images(folder, "depth")
    depth_paths = _nearest(stamps, depth_stamps, depths)
    if not (folder / "depth.txt").is_file():  # names like those of the images need be no times
        depth_paths = max(_beside(folder / "depth", paths), depth_paths, key=len)
    camera, truth_path = _named_camera(folder), truth_beside(folder)
    size = noted_size(paths[0])
    fits = camera is not None and size is not None and camera.fits(*size)
    trajectory, notes = None, [f"{len(depths)} depth"] if depths else []
    if truth_path is not None:
        trajectory = read_trajectory(truth_path)
        if camera is not None and camera.origin.startswith("Bonn"):
            trajectory = bonn_camera_trajectory(trajectory)
        notes.append(f"ground truth {np.ptp(trajectory.timestamps):.3g} s")
    return sources.Recording(
        name=sources.folder_name(folder),
        kind="TUM RGB-D folder",
        images=FileImages(paths),
        timestamps=stamps,
        calibration=calibration_beside(folder) or (camera if fits else None),
        trajectory=trajectory,
        depth_paths=depth_paths,
        mask_paths=_beside(folder / "masks", paths),
        static_paths=_beside(folder / "static", paths),
        novel_views=_novel_views(folder / "novel"),
        notes=notes,
    )


def _images(folder: Path, kind: str) -> tuple[np.ndarray, list[Path]]:
    """Return timestamps and paths of the images in `kind`.txt, or else in the folder `kind`."""
    list_path = folder / f"{kind}.txt"
    if not list_path.is_file():
        paths = list_images(folder / kind)
        return sources.stamps_of_names(paths)[0], paths
    stamps: list[float] = []
    paths = []
    for where, row in data_rows(read_text(list_path), str(list_path)):
        stamp, *name = row.split(maxsplit=1)
        stamps += finite_numbers([stamp], where)
        paths.append(folder.joinpath(*name))
        found = f"no file {paths[-1]}; complete the folder or remove the line"
        require(os.path.isfile(paths[-1]), f"'timestamp filename' of an image in {where}", found)
    return np.array(stamps), paths


def _named_camera(folder: Path) -> Calibration | None:
    """Return the camera that the folder's name, README or lists name."""
    notes = [folder.resolve().name]
    lists = [folder / "rgb.txt", folder / "groundtruth.txt"]
    for path in [*sorted(folder.glob("README*")), *lists]:
        if path.is_file():
            head = read_bytes(path).decode("utf-8", "replace").splitlines()[:20]
            notes += head if path.name.startswith("README") else [x for x in head if x[:1] == "#"]
    return next(filter(None, map(known_camera, notes)), None)


def known_camera(text: str) -> Calibration | None:
    """Return the intrinsics of the camera that a text names: freiburg1, fr3, rgbd_bonn."""
    found = _NAMES.search(text)
    if found is None:
        return None
    name = f"TUM fr{found[2]}" if found[2] else "Bonn"
    intrinsics, distortion = _CAMERAS[name]
    return Calibration(*intrinsics, (640, 480), BrownDistortion(*distortion), f"{name} intrinsics")


def bonn_camera_trajectory(markers: Trajectory) -> Trajectory:
    """Return the camera's poses from the published poses of Bonn's marker plate."""
    poses = _BONN_T_ros @ markers.T_world_camera @ _BONN_T_ros @ _BONN_T_marker_camera
    # The nearest rotation to each block: what follows relies on poses being rigid.
    u, _, v_transposed = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ v_transposed
    return Trajectory(markers.timestamps, poses)


def _nearest(stamps: np.ndarray, others: np.ndarray, paths: list[Path]) -> dict[int, Path]:
    """Return for each timestamp, by its number, the path of the nearest other if it is near."""
    found = {}
    for index, stamp in enumerate(stamps):
        apart = np.abs(others - stamp)
        if apart.min(initial=np.inf) <= _DEPTH_MAX_DIFFERENCE:
            found[index] = paths[apart.argmin()]
    return found


def _beside(folder: Path, paths: list[Path]) -> dict[int, Path]:
    """Return the PNG of the same stem in another folder for each path, where there is one."""
    candidates = enumerate(folder / f"{path.stem}.png" for path in paths)
    return {index: path for index, path in candidates if path.is_file()}


def _novel_views(folder: Path) -> list[tuple[np.ndarray, Path]]:
    """Return held-out views: poses.txt has one TUM row per image, its index as the timestamp."""
    if not (folder / "poses.txt").is_file():
        return []
    poses = read_trajectory(folder / "poses.txt")
    by_number = {int(p.stem): p for p in list_images(folder) if p.stem.isdecimal()}
    views = []
    for number, pose in zip(poses.timestamps.astype(int), poses.T_world_camera, strict=True):
        found = f"none for index {number}; complete the folder or remove the row"
        require(number in by_number, f"an image for every pose of {folder / 'poses.txt'}", found)
        views.append((pose, by_number[number]))
    return views
