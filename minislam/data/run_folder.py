"""The folder of one run: names and formats of its files. Each file is written atomically."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.data.files import atomic_write, read_bytes, read_json, write_json, write_text
from minislam.data.images import encode_png
from minislam.data.ply import GaussianArrays, read_ply, write_ply
from minislam.data.trajectory import read_trajectory, write_trajectory
from minislam.errors import InputError
from minislam.records import Trajectory

CONFIG, RUN, METRICS = "config.json", "run.json", "metrics.json"
TRAJECTORY, KEYFRAME_TRAJECTORY = "trajectory.txt", "keyframe_trajectory.txt"
LOST_FRAMES, MAP, MLP, REPORT = "lost_frames.txt", "map.ply", "uncertainty_mlp.pt", "report.html"
CHECKPOINT = "checkpoint.npz"
KEYFRAME_KINDS = ("input", "render", "depth", "beta")

_FILES = (
    CONFIG, RUN, METRICS, TRAJECTORY, KEYFRAME_TRAJECTORY, LOST_FRAMES, MAP, MLP, REPORT, CHECKPOINT
)  # fmt: skip
_FOLDERS = ("keyframes", "plots")


class RunFolder:
    """Reads and writes the files of one run. Nothing outside the folder is touched."""

    def __init__(self, path: Path | str) -> None:
        """Refer to an existing run folder."""
        self.path = Path(path)
        if not self.path.is_dir():
            raise InputError(
                f"expected a run folder, but {self.path} does not exist or is no folder; give the "
                "--output of an earlier run"
            )

    @classmethod
    def create(cls, path: Path | str, overwrite: bool = False) -> "RunFolder":
        """Make a new run folder; with `overwrite`, the files of an earlier run are removed.

        Files that no run writes are never removed.
        """
        path = Path(path)
        if path.exists() and not path.is_dir():
            raise InputError(
                f"expected an output folder, but {path} is a file; choose another name"
            )
        if path.is_dir() and any(path.iterdir()) and not overwrite:
            raise InputError(
                f"expected a new or empty output folder, but {path} holds files; choose another "
                "name or add --overwrite (or --resume, to go on with an interrupted run)"
            )
        try:
            for folder in _FOLDERS:
                (path / folder).mkdir(parents=True, exist_ok=True)
                for image in (path / folder).glob("*.png"):
                    image.unlink()
            for name in _FILES:
                (path / name).unlink(missing_ok=True)
        except OSError as error:
            raise InputError(
                f"expected to be able to write into {path}, but the system says: "
                f"{error.strerror}; choose another output folder"
            ) from error
        return cls(path)

    def write_config(self, config: dict[str, Any]) -> None:
        """Write sequence, input, priors and settings."""
        write_json(self.path / CONFIG, config)

    def write_run(self, facts: dict[str, Any]) -> None:
        """Write version, seed, command, timings and exit state."""
        write_json(self.path / RUN, facts)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write the errors against the ground truth."""
        write_json(self.path / METRICS, metrics)

    def write_trajectory(self, trajectory: Trajectory) -> None:
        """Write the poses of all tracked frames."""
        write_trajectory(self.path / TRAJECTORY, trajectory)

    def write_keyframe_trajectory(self, trajectory: Trajectory) -> None:
        """Write the poses of the keyframes."""
        write_trajectory(self.path / KEYFRAME_TRAJECTORY, trajectory)

    def write_lost_frames(self, lost: list[tuple[int, float, str]]) -> None:
        """Write (frame_index, timestamp [s], reason) of the frames without a pose."""
        rows = [f"{index} {stamp:.6f} {reason}\n" for index, stamp, reason in lost]
        write_text(self.path / LOST_FRAMES, "# frame_index timestamp reason\n" + "".join(rows))

    def write_map(self, gaussians: GaussianArrays) -> None:
        """Write the Gaussian map for 3D viewers."""
        write_ply(self.path / MAP, gaussians)

    def write_mlp(self, state: dict[str, Tensor]) -> None:
        """Write the weights of the uncertainty MLP."""
        buffer = io.BytesIO()
        torch.save(state, buffer)
        atomic_write(self.path / MLP, buffer.getvalue())

    def write_keyframe_image(self, frame_index: int, kind: str, image: np.ndarray) -> None:
        """Write one picture of a keyframe: (H, W, 3) RGB in [0, 1]; kind is input, render ..."""
        assert kind in KEYFRAME_KINDS, kind
        name = f"{frame_index:06d}_{kind}.png"
        atomic_write(self.path / "keyframes" / name, encode_png(np.asarray(image)))

    def write_plot(self, name: str, png: bytes) -> None:
        """Write the PNG bytes of a figure to plots/NAME.png."""
        assert re.fullmatch(r"[\w-]+", name), name
        atomic_write(self.path / "plots" / f"{name}.png", png)

    def write_report(self, html: str) -> None:
        """Write the report to open in a browser."""
        write_text(self.path / REPORT, html)

    def write_checkpoint(self, tree: dict[str, Any]) -> None:
        """Write the state from which an interrupted run can continue."""
        write_checkpoint(self.path / CHECKPOINT, tree)

    def read_checkpoint(self, gpu: str = "cpu") -> dict[str, Any]:
        """Return the state from which an interrupted run can continue, see `read_checkpoint`."""
        if not (self.path / CHECKPOINT).exists():
            raise InputError(
                f"expected {CHECKPOINT} of an interrupted run in {self.path}, found none; give the "
                "folder of such a run, or leave out --resume to start anew"
            )
        return read_checkpoint(self.path / CHECKPOINT, gpu)

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint, which a finished run does not need."""
        (self.path / CHECKPOINT).unlink(missing_ok=True)

    def read_config(self) -> dict[str, Any]:
        """Return sequence, input, priors and settings."""
        return read_json(self.path / CONFIG)

    def read_run(self) -> dict[str, Any]:
        """Return version, seed, command, timings and exit state."""
        return read_json(self.path / RUN)

    def read_metrics(self) -> dict[str, Any]:
        """Return the errors against the ground truth."""
        return read_json(self.path / METRICS)

    def read_trajectory(self) -> Trajectory:
        """Return the poses of all tracked frames."""
        return read_trajectory(self.path / TRAJECTORY)

    def read_keyframe_trajectory(self) -> Trajectory:
        """Return the poses of the keyframes."""
        return read_trajectory(self.path / KEYFRAME_TRAJECTORY)

    def read_map(self) -> GaussianArrays:
        """Return the Gaussian map."""
        return read_ply(self.path / MAP)

    def read_mlp(self) -> dict[str, Tensor]:
        """Return the weights of the uncertainty MLP."""
        content = read_bytes(self.path / MLP)
        try:
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        except Exception as error:  # damaged bytes fail inside torch in many different ways
            raise InputError(
                f"expected the weights of the uncertainty MLP in {self.path / MLP}, but the file "
                "cannot be read; it is damaged or from another program"
            ) from error
