"""Plain image folders and video files."""

import math
import re
from pathlib import Path

import numpy as np

from minislam.data.calibration import Calibration, read_calibration
from minislam.data.images import is_image, list_images
from minislam.data.metadata import noted_focal_length
from minislam.data.sources import ASSUMED_FRAME_RATE, FileImages, Recording, VideoImages
from minislam.errors import InputError

_IMAGE_FOLDERS = ("images", "rgb")
_VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


def read_image_folder(folder: Path) -> Recording:
    """Read a folder of images, in natural order; they may lie in `images/` or `rgb/`."""
    candidates = [folder] + [folder / name for name in _IMAGE_FOLDERS if (folder / name).is_dir()]
    paths = next((found for found in map(list_images, candidates) if found), [])
    if not paths:
        raise InputError(f"expected PNG or JPEG images in {folder}, found none; {_hint(folder)}")
    stamps, source = stamps_of_names(paths)
    return Recording(
        name=folder_name(folder),
        kind="image folder",
        images=FileImages(paths),
        timestamps=stamps,
        calibration=calibration_beside(folder),
        noted_focal_length=noted_focal_length(paths[0]),
        notes=[source],
    )


def read_video(path: Path, limit: int | None) -> Recording:
    """Read a video file; frames after the first `limit` are left alone."""
    if is_image(path):
        raise InputError(
            f"expected a video or a folder, found the single image {path}; give the folder it is in"
        )
    images = VideoImages(path, limit)
    if len(images) == 0:
        raise InputError(f"expected frames in {path}, found none; convert the video to MP4 (H.264)")
    warnings = []
    rate, stamps, lost = images.frame_rate, images.timestamps, images.lost()
    if not (np.isfinite(stamps).all() and (np.diff(stamps) > 0).all()):
        if not (math.isfinite(rate) and rate > 0):
            rate = ASSUMED_FRAME_RATE
        stamps, lost = np.arange(len(images)) / rate, lost[:0]
        warnings.append(f"{path.name} has no timestamps: {rate:g} frames per second assumed")
    if len(images) < images.promised and len(images) != limit:
        warnings.append(
            f"{path.name} promises {images.promised} frames, but only {len(images)} can be decoded"
        )
    return Recording(
        name=folder_name(path.with_suffix("")),
        kind="video",
        images=images,
        timestamps=stamps,
        lost=[(stamp, f"{path.name} is damaged there") for stamp in lost.tolist()],
        calibration=calibration_beside(path.parent, path.stem + ".calibration.txt"),
        noted_focal_length=noted_focal_length(path),
        notes=[f"{rate:g} frames per second"],
        warnings=warnings,
    )


def stamps_of_names(paths: list[Path]) -> tuple[np.ndarray, str]:
    """Return the timestamps (N,) of images, and a note that says where they come from.

    Names that are all numbers are the timestamps; otherwise the images are counted.
    """
    names = [path.stem for path in paths]
    if not all(re.fullmatch(r"\d+(\.\d+)?", name, re.ASCII) for name in names):
        return (
            np.arange(len(names)) / ASSUMED_FRAME_RATE,
            f"timestamps counted at {ASSUMED_FRAME_RATE:g} frames per second",
        )
    stamps = np.array([float(name) for name in names])
    same = np.flatnonzero(~(np.diff(stamps) > 0))
    if len(same):
        first, second = paths[same[0]], paths[same[0] + 1]
        raise InputError(
            f"expected file names that are increasing timestamps, found {first.name} and "
            f"{second.name} in {first.parent}; remove or rename one of them"
        )
    return stamps, "timestamps from the file names"


def calibration_beside(folder: Path, name: str = "calibration.txt") -> Calibration | None:
    """Return the calibration that lies beside the images, if there is one."""
    path = folder / name
    return read_calibration(path) if path.is_file() else None


def folder_name(path: Path) -> str:
    """Return a name of a source that can be used for an output folder."""
    return re.sub(r"[^\w.-]+", "_", path.resolve().name).strip("._") or "sequence"


def _hint(folder: Path) -> str:
    """Say what the user may have meant: often the video or data set lies one level deeper."""
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    videos = [path for path in entries if path.suffix.lower() in _VIDEO_SUFFIXES]
    if videos:
        return f"give the video itself, {videos[0]}"
    folders = [path for path in entries if path.is_dir()]
    if folders:
        return f"perhaps you mean {folders[0]}"
    return "give a folder that holds images, a video file, or synth:NAME"
