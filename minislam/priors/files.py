"""Features and depth made elsewhere, by `minislam priors` or anything else: one file per frame."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from minislam.errors import InputError, require
from minislam.geometry import Camera
from minislam.parameters import user_path
from minislam.priors.depth import as_depth
from minislam.priors.names import FILES
from minislam.records import Frame, Sequence

INDEX = "frames.txt"  # beside the files: which of them belongs to which moment
FEATURES, DEPTH = "features", "depth"  # folders of one sequence's priors
_FOLDERS = {FEATURES: ("features",), DEPTH: ("depth", "depths")}  # the last: of WildGS-SLAM
# The number at the end of an image's name, with or without its ending; no part of a decimal one.
_NUMBER = re.compile(r"(?<![.\d])(\d{1,9})(\.png|\.jpe?g)?$", re.ASCII | re.IGNORECASE)
_AXES = {FEATURES: ("rows", "columns", "channels"), DEPTH: ("rows", "columns")}
_MAKE = "make them from this sequence with minislam priors"  # advice where files are missing


class FrameFiles:
    """Finds the file of a frame in a folder.

    Files are named by frame index (`17.npy`, `00017.png`). If the folder has an index, a frame is
    found by its timestamp, so that a run on fewer of the frames finds the right files.
    """

    def __init__(self, folder: Path, what: str, endings: tuple[str, ...]) -> None:
        self.folder, self.what = folder, what  # "depth" or "features", for messages
        # Sorted, so that of 17.npy and 17.png the same one wins on every machine.
        files = sorted(p for p in self.folder.glob("*") if p.suffix.lower() in endings)
        self.paths = {int(path.stem): path for path in files if path.stem.isdecimal()}
        wanted = f"{' or '.join(endings)} files named by frame index in {self.folder}"
        found = f"{len(files)} such files and none that fits; name them like 00017.npy"
        require(bool(self.paths), wanted, found)
        index = self.folder / INDEX
        self._number_of = _read_index(index) if index.is_file() else None

    def require_frames_of(self, sequence: Sequence) -> None:
        """Refuse files that are numbered like all images where a frame has another number."""
        frame = len(sequence) - 1
        image, index = sequence.source_name(frame), sequence.source_index(frame)
        # Of the first images, counted from 1, a file 0 shows that the files are counted from 0.
        if self._number_of is not None or (index == frame and 0 in self.paths):
            return
        numbers = [*(int(found[1]) for found in _NUMBER.finditer(image)), index]
        wrong = [self.paths[n] for n in numbers if n != frame and n in self.paths]
        if wrong:
            wanted = f"{self.what} files named by the frame of the run, {frame:05d} for {image}"
            found = f"{wrong[0]}, which has the number of that image"
            advice = f"rename them, or write {INDEX} beside them, as minislam priors does"
            raise InputError(f"expected {wanted}, found {found}; {advice}")

    def of(self, frame: Frame) -> Path | None:
        """Return the file of a frame, or None if the folder has none for it."""
        if self._number_of is None:
            return self.paths.get(frame.frame_index)
        moment = round(frame.timestamp, 6)
        found = f"no such frame in {self.folder / INDEX}; {_MAKE}"
        require(moment in self._number_of, f"{self.what} of the frame at {moment:.6f} s", found)
        return self.paths.get(self._number_of[moment])


class FileFeatures:
    """Features made elsewhere, from .npy files (h', w', C): a `FeatureExtractor`."""

    def __init__(self, folder: Path, camera: Camera, sequence: Sequence | None = None) -> None:
        """Open a folder; raises InputError where it lacks files of the sequence or has others."""
        self.files = FrameFiles(folder, "features", (".npy",))
        if sequence is not None:
            wanted = f"features of every frame in {folder}, {len(sequence)} files"
            count = len(self.files.paths)
            require(count >= len(sequence), wanted, f"{count}; {_MAKE}")
            self.files.require_frames_of(sequence)
        first = self.files.paths[min(self.files.paths)]
        rows, _, self.dimension = read_array(first, FEATURES).shape
        self.stride = max(1, round(camera.height / rows))

    def __call__(self, frame: Frame) -> Tensor:  # (h', w', C) float32
        path = self.files.of(frame)
        if path is None:
            wanted = f"features of every frame in {self.files.folder}"
            found = f"none for frame {frame.frame_index}"
            raise InputError(f"expected {wanted}, found {found}; {_MAKE}")
        features = read_array(path, FEATURES).astype(np.float32)
        rows, cols, channels = features.shape
        is_finite = bool(np.isfinite(features).all())
        wanted = f"finite features of {self.dimension} channels in {path}"
        found = f"{channels if is_finite else 'NaN or infinity'}; write all with one network"
        require(is_finite and channels == self.dimension, wanted, found)
        height, width = frame.image.shape[:2]
        # Whole patches are counted, so each side of the grid may lack up to one of them.
        covers = abs(rows - cols * height / width) <= max(1, height / width)
        found = f"a grid of {cols}x{rows}, of another aspect ratio; crop it like the image"
        require(covers, f"{path} to cover the image of {width}x{height}", found)
        return torch.from_numpy(features).to(frame.image.device)


class FileDepth:
    """Depth made elsewhere, from .npy (world units) or 16-bit .png files: a `DepthPrior`."""

    def __init__(self, folder: Path, read_png: Callable[[Path], np.ndarray]) -> None:
        self._read_png = read_png  # (H, W) world units; `Sequence.read_depth`
        self.files = FrameFiles(folder, "depth", (".npy", ".png"))

    def __call__(self, frame: Frame, camera: Camera) -> Tensor | None:
        """Read the depth of a frame, resized to its image, or return None if there is no file."""
        path = self.files.of(frame)
        if path is None:
            return None
        depth = read_array(path, DEPTH) if path.suffix.lower() == ".npy" else self._read_png(path)
        return as_depth(depth, frame, str(path))


def folder_of(name: str, kind: str) -> Path:
    """Return where the files of a kind are: in the subfolder of that name, or in the folder."""
    folder = user_path(name.removeprefix(FILES))
    return next((folder / sub for sub in _FOLDERS[kind] if (folder / sub).is_dir()), folder)


def index_text(origin: str, frames: list[tuple[int, float]]) -> str:
    """Return the content of an index: frame index and timestamp [s] of every frame."""
    rows = "".join(f"{number} {timestamp:.6f}\n" for number, timestamp in frames)
    return f"# {origin}\n# frame_index timestamp\n{rows}"


def read_array(path: Path, kind: str) -> np.ndarray:
    """Return the array of an .npy file of features (rows, columns, channels) or depth."""
    try:
        with open(path, "rb") as file:
            array = np.lib.format.read_array(file)
    except Exception as error:  # damaged bytes fail inside numpy in many ways
        found = f"an unreadable file {path}; write it again"
        raise InputError(f"expected a numpy array of {kind}, found {found}") from error
    array = np.squeeze(array) if kind == DEPTH else array
    axes, is_float = _AXES[kind], np.issubdtype(array.dtype, np.floating)
    wanted = f"floating-point {kind} of shape ({', '.join(axes)}) in {path}"
    found = f"{array.dtype} of shape {array.shape}; store one such array per file"
    require(is_float and array.ndim == len(axes) and array.size > 0, wanted, found)
    return array


def _read_index(path: Path) -> dict[float, int]:
    try:
        rows = path.read_text(encoding="utf-8").splitlines()
        pairs = [row.split() for row in rows if row and not row.startswith("#")]
        return {round(float(timestamp), 6): int(number) for number, timestamp in pairs}
    except (OSError, ValueError) as error:
        wanted = f"rows of frame index and timestamp in {path}"
        found = f"something else ({error}); write it again with minislam priors, or remove it"
        raise InputError(f"expected {wanted}, found {found}") from error
