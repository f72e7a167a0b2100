"""TUM RGB-D folders, and the ground truth that synthetic sequences add to them."""

import os
import re
from pathlib import Path

import numpy as np

from minislam.data.calibration import Calibration
from minislam.data.files import data_rows, finite_numbers, read_bytes, read_text
from minislam.data.folder import calibration_beside, folder_name, stamps_of_names
from minislam.data.images import list_images, read_color
from minislam.data.known_cameras import bonn_camera_trajectory, is_bonn, known_camera
from minislam.data.recording import Recording
from minislam.data.sources import FileImages
from minislam.data.trajectory import read_trajectory
from minislam.errors import InputError

_TRUTH_NAMES = ("groundtruth.txt", "pose.txt")  # TUM and Bonn; Wild-SLAM
_DEPTH_MAX_DIFFERENCE = 0.02  # second between a colour and its depth image, as TUM's associate.py


def is_tum_folder(folder: Path) -> bool:
    """Tell by the content: a list rgb.txt, or rgb/ with file names that are times in seconds."""
    if (folder / "rgb.txt").is_file():
        return True
    images = list_images(folder / "rgb") if (folder / "rgb").is_dir() else []
    return bool(images) and all(re.fullmatch(r"\d+\.\d+", path.stem) for path in images)


def read_tum_folder(folder: Path) -> Recording:
    """Read a TUM RGB-D folder; everything but the colour images is optional."""
    stamps, paths = _images(folder, "rgb")
    if len(paths) == 0:
        raise InputError(f"expected images in {folder}/rgb.txt, found none; check the list")
    depth_stamps, depths = _images(folder, "depth")
    truth_path = next((folder / name for name in _TRUTH_NAMES if (folder / name).is_file()), None)
    trajectory = read_trajectory(truth_path) if truth_path else None
    if trajectory is not None and is_bonn(folder.resolve().name):
        trajectory = bonn_camera_trajectory(trajectory)
    notes = [f"{len(depths)} depth"] if depths else []
    if trajectory is not None:
        seconds = trajectory.timestamps[-1] - trajectory.timestamps[0]
        notes.append(f"ground truth {seconds:.3g} s")
    return Recording(
        name=folder_name(folder),
        kind="TUM RGB-D folder",
        images=FileImages(paths),
        timestamps=stamps,
        calibration=calibration_beside(folder) or _calibration_by_name(folder, paths[0]),
        trajectory=trajectory,
        depth_paths=_nearest(stamps, depth_stamps, depths),
        mask_paths=_beside(folder / "masks", paths),
        static_paths=_beside(folder / "static", paths),
        novel_views=_novel_views(folder / "novel"),
        notes=notes,
    )


def parse_image_list(text: str, name: str) -> tuple[np.ndarray, list[str]]:
    """Parse lines of `timestamp filename`; `name` goes into the errors.

    Returns the timestamps (N,) in seconds and the N file names.
    """
    stamps: list[float] = []
    names: list[str] = []
    for number, row in data_rows(text):
        where = f"line {number} of {name}"
        fields = row.split(maxsplit=1)
        if len(fields) != 2:
            raise InputError(
                f"expected 'timestamp filename', found '{row[:80]}' in {where}; correct this line"
            )
        stamp = finite_numbers(fields[:1], where)[0]
        if stamps and stamp <= stamps[-1]:
            raise InputError(
                f"expected timestamps that increase, found {fields[0]} after {stamps[-1]:.6f} in "
                f"{where}; sort the list and remove double entries"
            )
        stamps.append(stamp)
        names.append(fields[1])
    return np.array(stamps), names


def _images(folder: Path, kind: str) -> tuple[np.ndarray, list[Path]]:
    """Return timestamps and paths of the images in `kind`.txt, or else in the folder `kind`."""
    list_path = folder / f"{kind}.txt"
    if not list_path.is_file():
        paths = list_images(folder / kind) if (folder / kind).is_dir() else []
        return (stamps_of_names(paths)[0], paths) if paths else (np.zeros(0), [])
    stamps, names = parse_image_list(read_text(list_path), str(list_path))
    paths = [folder / name for name in names]
    missing = next((path for path in paths if not os.path.isfile(path)), None)
    if missing is not None:
        raise InputError(
            f"expected all images of {list_path}, but {missing} does not exist; complete the "
            "folder or remove the line"
        )
    return stamps, paths


def _calibration_by_name(folder: Path, image: Path) -> Calibration | None:
    """Return the known camera that the folder's name, README or lists name (freiburg1, ...).

    Images of another aspect ratio than the benchmark's come from another camera: None.
    """
    notes = [folder.resolve().name]
    lists = [folder / "rgb.txt", folder / "groundtruth.txt"]
    for path in [*sorted(folder.glob("README*")), *lists]:
        if path.is_file():
            head = read_bytes(path).decode("utf-8", "replace").splitlines()[:20]
            notes += head if path.name.startswith("README") else [x for x in head if x[:1] == "#"]
    found = next(filter(None, map(known_camera, notes)), None)
    height, width = read_color(image).shape[:2]
    return found if found is not None and found.fits(width, height) else None


def _nearest(stamps: np.ndarray, others: np.ndarray, paths: list[Path]) -> list[Path | None]:
    """Return for each timestamp the path whose own timestamp is nearest, None if none is near."""
    if len(others) == 0:
        return [None] * len(stamps)
    after = np.searchsorted(others, stamps).clip(1, max(len(others) - 1, 1))
    before = after - 1
    after = after.clip(max=len(others) - 1)
    nearest = np.where(stamps - others[before] <= others[after] - stamps, before, after)
    near = np.abs(others[nearest] - stamps) <= _DEPTH_MAX_DIFFERENCE
    return [paths[index] if ok else None for index, ok in zip(nearest, near, strict=True)]


def _beside(folder: Path, paths: list[Path]) -> list[Path | None]:
    """Return the PNG of the same stem in another folder for each path, None where missing."""
    candidates = [folder / (path.stem + ".png") for path in paths]
    return [path if path.is_file() else None for path in candidates]


def _novel_views(folder: Path) -> list[tuple[np.ndarray, Path]]:
    """Return held-out views: poses.txt has one TUM row per image, its index as the timestamp."""
    if not (folder / "poses.txt").is_file():
        return []
    poses = read_trajectory(folder / "poses.txt")
    by_number = {int(p.stem): p for p in list_images(folder) if p.stem.isdecimal()}
    missing = [int(stamp) for stamp in poses.timestamps if int(stamp) not in by_number]
    if missing:
        raise InputError(
            f"expected an image for every pose of {folder / 'poses.txt'}, found none for index "
            f"{missing[0]}; complete the folder or remove the row"
        )
    rows = zip(poses.timestamps, poses.T_world_camera, strict=True)
    return [(T_world_camera, by_number[int(stamp)]) for stamp, T_world_camera in rows]
