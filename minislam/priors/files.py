"""Features and depth made elsewhere: a folder with one file per frame.

`minislam priors` writes such folders, and so may anything else: heavy networks then run once,
where there is a GPU, and the SLAM runs anywhere.
"""

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.depth import as_depth
from minislam.priors.names import FILES
from minislam.records import Frame

INDEX = "frames.txt"  # beside the files: which of them belongs to which moment
FEATURES, DEPTH = "features", "depth"  # folders of one sequence's priors
_ALSO_DEPTH = "depths"  # the folder's name where WildGS-SLAM writes its own


class FrameFiles:
    """Finds the file of a frame in a folder.

    Files are named by frame index (`17.npy`, `00017.png`). If the folder has an index, a frame is
    found by its timestamp, so that a run on fewer of the frames finds the right files.
    """

    def __init__(self, folder: Path | str, what: str, endings: tuple[str, ...]) -> None:
        self.folder = Path(folder)
        self.what = what  # "depth" or "features", for messages
        if not self.folder.is_dir():
            raise InputError(
                f"expected a folder of {what} files, found nothing at {self.folder}; check the path"
            )
        # Sorted, so that of 17.npy and 17.png the same one wins on every machine.
        files = sorted(p for p in self.folder.iterdir() if p.suffix.lower() in endings)
        self._files = {int(path.stem): path for path in files if path.stem.isdecimal()}
        if not self._files:
            raise InputError(
                f"expected {' or '.join(endings)} files named by frame index in {self.folder}, "
                f"found {len(files)} such files and none that fits; name them like 00017.npy"
            )
        self.first = self._files[min(self._files)]
        index = self.folder / INDEX
        self._number_of = _read_index(index) if index.is_file() else None

    def of(self, frame: Frame) -> Path | None:
        """Return the file of a frame, or None if the folder has none for it."""
        if self._number_of is None:
            return self._files.get(frame.frame_index)
        moment = stamp(frame.timestamp)
        if moment not in self._number_of:
            raise InputError(
                f"expected {self.what} of the frame at {moment} s, found no such frame in "
                f"{self.folder / INDEX}; make them from this sequence with minislam priors"
            )
        return self._files.get(self._number_of[moment])


class FileFeatures:
    """Features made elsewhere, from .npy files (h', w', C): a `FeatureExtractor`."""

    def __init__(self, folder: Path | str, camera: Camera) -> None:
        self._files = FrameFiles(folder, "features", (".npy",))
        rows, _, self.dimension = _read_features(self._files.first).shape
        self.stride = max(1, round(camera.height / rows))

    def __call__(self, frame: Frame) -> Tensor:  # (h', w', C) float32
        """Read the features of a frame."""
        path = self._files.of(frame)
        if path is None:
            raise InputError(
                f"expected features of every keyframe in {self._files.folder}, found none for "
                f"frame {frame.frame_index}; make them from this sequence with minislam priors"
            )
        features = _read_features(path)
        rows, cols, channels = features.shape
        if channels != self.dimension:
            raise InputError(
                f"expected {self.dimension} channels in {path} as in the other files, found "
                f"{channels}; write all of them with one network"
            )
        height, width = frame.image.shape[:2]
        # Whole patches are counted, so each side of the grid may lack up to one of them.
        if abs(rows - cols * height / width) > max(1, height / width):
            raise InputError(
                f"expected {path} to cover the image of {width}x{height}, found a grid of "
                f"{cols}x{rows}, of another aspect ratio; crop it like the image"
            )
        return torch.from_numpy(features).to(frame.image.device)


class FileDepth:
    """Depth made elsewhere, from .npy (world units) or 16-bit .png files: a `DepthPrior`."""

    def __init__(
        self,
        folder: Path | str,
        png_unit: float = 1 / 5000,  # world units of one count in a .png; TUM and Bonn: 1 / 5000 m
    ) -> None:
        self.png_unit = png_unit
        self._files = FrameFiles(folder, "depth", (".npy", ".png"))

    def __call__(self, frame: Frame, camera: Camera) -> Tensor | None:
        """Read the depth of a frame, resized to its image, or return None if there is no file."""
        path = self._files.of(frame)
        if path is None:
            return None
        if path.suffix.lower() == ".npy":
            return as_depth(_read_depth(path), frame, str(path))
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if counts is None or counts.ndim != 2 or counts.dtype != np.uint16:
            raise InputError(
                f"expected a single-channel 16-bit .png of depth, found something else in {path}; "
                "export depth, not its coloured picture"
            )
        return as_depth(counts.astype(np.float32) * self.png_unit, frame, str(path))


def folder_of(name: str, kind: str) -> Path:
    """Return where the files of a kind are: in the subfolder of that name, or in the folder."""
    folder = Path(name.removeprefix(FILES)).expanduser()
    parts = [kind, _ALSO_DEPTH] if kind == DEPTH else [kind]
    return next((folder / part for part in parts if (folder / part).is_dir()), folder)


def index_text(origin: str, frames: list[tuple[int, float]]) -> str:
    """Return the content of an index: frame index and timestamp [s] of every frame."""
    rows = "".join(f"{number} {stamp(timestamp)}\n" for number, timestamp in frames)
    return f"# {origin}\n# frame_index timestamp\n{rows}"


def stamp(timestamp: float) -> str:
    """Return a timestamp [s] as text, to the microsecond, so that equal ones are found."""
    return f"{timestamp:.6f}"


def read_array(path: Path, what: str) -> np.ndarray:
    """Return the array of an .npy file of floating-point numbers."""
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # damaged bytes fail inside numpy in many ways
        raise InputError(
            f"expected a numpy array of {what}, found an unreadable file {path}; write it again"
        ) from error
    if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, np.floating):
        raise InputError(
            f"expected floating-point {what} in {path}, found {getattr(array, 'dtype', 'several')}"
            "; store one array of float32 per file"
        )
    return array


def _read_features(path: Path) -> np.ndarray:
    features = read_array(path, "features")
    if features.ndim != 3 or features.size == 0 or not np.isfinite(features).all():
        raise InputError(
            f"expected finite features of shape (rows, columns, channels) in {path}, found shape "
            f"{features.shape}; write it again"
        )
    return features.astype(np.float32)


def _read_depth(path: Path) -> np.ndarray:
    depth = np.squeeze(read_array(path, "depth"))
    if depth.ndim != 2 or depth.size == 0:
        raise InputError(
            f"expected depth of shape (H, W) in {path}, found {depth.dtype} of shape "
            f"{depth.shape}; store one depth map in world units per file"
        )
    return depth


def _read_index(path: Path) -> dict[str, int]:
    try:
        rows = path.read_text(encoding="utf-8").splitlines()
        pairs = [row.split() for row in rows if row and not row.startswith("#")]
        return {stamp(float(timestamp)): int(number) for number, timestamp in pairs}
    except (OSError, ValueError) as error:
        raise InputError(
            f"expected rows of frame index and timestamp in {path}, found something else "
            f"({error}); write it again with minislam priors, or remove it"
        ) from error
