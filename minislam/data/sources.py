"""Recordings: raw images, files in a folder or a video, and what lies beside them."""

import math
import re
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from minislam.data.calibration import Calibration, calibration_beside
from minislam.data.images import is_image, is_number, list_images
from minislam.data.metadata import noted_focal_length
from minislam.data.options import mask_folder
from minislam.data.raw_images import FileImages, ImageSource, VideoImages
from minislam.data.run_folder import CONFIG, RUN
from minislam.data.trajectory import truth_beside
from minislam.errors import InputError, require
from minislam.records import Trajectory

_OTHER_IMAGES = ".heic .heif .avif .tif .tiff .webp .gif .bmp .dng .cr2 .cr3 .nef .arw".split()
_VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
_LISTS = b"ffconcat", b"#EXTM3U"  # how texts begin for which FFmpeg opens other files

_ASSUMED_FRAME_RATE = 30.0  # frames per second, if neither names nor container state it
_COUNTED = f"timestamps counted at {_ASSUMED_FRAME_RATE:g} frames per second"
_CLOCKS = {13: ("ms", 1e-3), 16: ("us", 1e-6), 19: ("ns", 1e-9)}  # by digits, of times since 1970
_MOST_COUNTED = 1e6  # larger whole numbers in names are times


@dataclass(frozen=True)
class Recording:
    """Raw images with timestamps, and what lies beside them: files by the number of the image."""

    name: str  # short, usable as a folder name
    kind: str  # what it is, for the description
    images: ImageSource
    timestamps: np.ndarray  # (N,) float64 second, strictly increasing
    calibration: Calibration | None = None  # None: unknown
    noted_focal_length: tuple[float, str] | None = None  # over the image diagonal, and its origin
    trajectory: Trajectory | None = None  # ground truth
    depth_paths: dict[int, Path] = field(default_factory=dict)
    mask_paths: dict[int, Path] = field(default_factory=dict)  # True on dynamic objects
    static_paths: dict[int, Path] = field(default_factory=dict)  # without dynamic objects
    novel_views: list[tuple[np.ndarray, Path]] = field(default_factory=list)  # (T_world_camera, .)
    unread: list[tuple[float, str]] = field(default_factory=list)  # timestamp [s], reason
    notes: list[str] = field(default_factory=list)  # more for the description
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        stamps = np.round(self.timestamps, 6)
        if len(wrong := np.flatnonzero(np.diff(stamps) <= 0)):
            both = [f"{stamps[k]} s of {self.images.labels[k]}" for k in (wrong[0], wrong[0] + 1)]
            wanted = "timestamps that increase by a microsecond at least"
            found = f"{' before '.join(both)}; sort, remove or rename them"
            raise InputError(f"expected {wanted}, found {found}")


def read_image_folder(folder: Path) -> Recording:
    """Read a folder of images, in natural order; they may lie in `images/` or `rgb/`."""
    paths = next(filter(None, map(list_images, (folder, folder / "images", folder / "rgb"))), [])
    if not paths:
        raise InputError(f"expected PNG or JPEG images in {folder}, found {_found(folder)}")
    stamps, source = stamps_of_names(paths)
    if _are_counts(paths, stamps) and not truth_beside(folder):  # whose times are the numbers
        stamps, source = stamps / _ASSUMED_FRAME_RATE, _COUNTED
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
    found = f"the single image {path}; give the folder it is in"
    require(not is_image(path), "a video or a folder", found)
    with open(path, "rb") as file:
        is_list = file.read(8).startswith(_LISTS)
    require(not is_list, "a video", f"a list of others in {path}; give one of these")
    images = VideoImages(path, limit)
    require(len(images) > 0, f"frames in {path}", "none; convert the video to MP4 (H.264)")
    rate, stamps, unread = images.frame_rate, images.timestamps, images.unread()
    warnings: list[str] = []
    if not (np.isfinite(stamps).all() and (np.diff(stamps) > 0).all()):
        if not (math.isfinite(rate) and rate > 0):
            rate = _ASSUMED_FRAME_RATE
        stamps, unread = np.arange(len(images)) / rate, unread[:0]
        assumed = f"{rate:g} frames per second assumed"
        warnings.append(f"{path.name} has no times that increase: {assumed}")
    if len(images) < images.promised:
        found = f"{images.promised} frames, but only {len(images)} can be decoded"
        cause = "it is damaged, or was trimmed on a phone"
        warnings.append(f"{path.name} promises {found}: {cause}")
    return Recording(
        name=folder_name(path.with_suffix("")),
        kind="video" if images.is_whole else f"first {limit} images of a video",
        images=images,
        timestamps=stamps,
        unread=[(stamp, f"{path.name} is damaged there") for stamp in unread.tolist()],
        calibration=calibration_beside(path.parent, path.stem + ".calibration.txt"),
        noted_focal_length=noted_focal_length(path),
        notes=[f"{rate:.4g} frames per second"],
        warnings=warnings,
    )


def stamps_of_names(paths: list[Path]) -> tuple[np.ndarray, str]:
    """Return timestamps (N,): the names if all are numbers, else a count; and a note on that."""
    if not all(is_number(path.stem) for path in paths):
        return np.arange(len(paths)) / _ASSUMED_FRAME_RATE, _COUNTED
    digits = {len(path.stem) for path in paths if path.stem.isdecimal()}
    unit, second = _CLOCKS.get(digits.pop(), ("s", 1.0)) if len(digits) == 1 else ("s", 1.0)
    stamps = np.array([float(path.stem) for path in paths]) * second
    return stamps, f"timestamps [{unit}] from the file names"


def _are_counts(paths: list[Path], numbers: np.ndarray) -> bool:
    """Tell whether names count images: whole numbers, not too large, in multiples of a step."""
    least = (steps := np.diff(numbers)).min(initial=_MOST_COUNTED)
    is_even = least >= 1 and not (steps % least).any() and numbers[-1] < _MOST_COUNTED
    return is_even and all(path.stem.isdecimal() for path in paths)


def folder_name(path: Path) -> str:
    """Return a name of a source that can be used for an output folder."""
    return re.sub(r"[^\w.-]+", "_", path.resolve().name).strip("._") or "sequence"


def _found(folder: Path) -> str:
    """Say what is there, and what to do: often the video or data set lies one level deeper."""
    if (folder / RUN).is_file():
        return f"the folder of a run; to repeat it, give --config {folder / CONFIG}"
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    if videos := [path for path in entries if path.suffix.lower() in _VIDEO_SUFFIXES]:
        return f"none; give the video itself, {videos[0]}"
    suffixes = [path.suffix.lower() for path in entries]
    if others := [suffix for suffix in suffixes if suffix in _OTHER_IMAGES]:
        return f"{suffixes.count(others[0])} {others[0]}; convert them to JPEG or PNG"
    if folders := [path for path in entries if path.is_dir()]:
        return f"none; perhaps you mean {folders[0]}"
    return "none; give a folder that holds images, a video file, or synth:NAME"


def mask_files(images: ImageSource, masks: str, chosen: list[int]) -> dict[int, Path]:
    """Return masks of files:FOLDER by number of the image; refuse it if a chosen image has none."""
    folder = mask_folder(masks)
    files = {_stem(path): path for path in list_images(folder)}
    named = {k: files[_stem(path)] for k, path in enumerate(images.paths) if _stem(path) in files}
    numbered = {int(name): path for name, path in files.items() if name.isdecimal()}
    found = named if named and isinstance(images, FileImages) else numbered
    # Counted from 1, as ffmpeg does, the last mask has the number of images.
    is_shifted = found is numbered and 0 not in numbered and {1, len(images)} <= {*numbered}
    wanted, advice = f"masks counted from 0 in {folder}", "or name them like the images"
    require(not is_shifted, wanted, f"1 to {len(images)}; count them anew, {advice}")
    if missing := [images.labels[index] for index in chosen if index not in found]:
        without = f"none for {len(missing)} of {len(chosen)}, such as {missing[0]}"
        advice = "name them like the images or by number from 0; a black one where nothing moves"
        raise InputError(f"expected a mask of every frame in {folder}, found {without}; {advice}")
    return found


def _stem(path: Path) -> str:
    """Return a name in composed letters; archives of macOS have accents apart."""
    return unicodedata.normalize("NFC", path.stem)
