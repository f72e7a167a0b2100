"""The folder of one run: names of its files (without torch), what may be overwritten, reading."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from minislam.data import files
from minislam.errors import InputError, require
from minislam.parameters import user_path

if TYPE_CHECKING:
    from torch import Tensor

    from minislam.records import Trajectory

CONFIG, RUN, METRICS, CAMERA = "config.json", "run.json", "metrics.json", "camera.json"
TRAJECTORY, KEYFRAME_TRAJECTORY = "trajectory.txt", "keyframe_trajectory.txt"
LOST_FRAMES, MAP, MAP_SH, MLP = "lost_frames.txt", "map.ply", "map_sh.ply", "uncertainty_mlp.pt"
CHECKPOINT, LOG, REPORT = "checkpoint.npz", "log.txt", "report.html"
VIEWER, CLIP = "viewer.html", "clip.webp"

_FILES = (
    CONFIG, RUN, METRICS, CAMERA, TRAJECTORY, KEYFRAME_TRAJECTORY, LOST_FRAMES, MAP, MAP_SH, MLP,
    CHECKPOINT, LOG, REPORT, VIEWER, CLIP,
)  # fmt: skip
KEYFRAMES, PLOTS = "keyframes", "plots"  # folders
_HALF = r"\.[0-9a-f]{8}\.tmp"  # behind the name of a file that is being written
_BEGUN = re.compile(f"{KEYFRAMES}|{PLOTS}|{re.escape(CONFIG)}{_HALF}")  # its first entries
_OURS = re.compile(  # every path that a run writes, inside its folder, also half-written
    rf"({'|'.join(map(re.escape, _FILES))}|{KEYFRAMES}/\d{{6,}}_(input|render|depth|beta)\.png|"
    rf"{PLOTS}/(ate_over_time|trajectory|losses|gaussians|health|overview)\.png)"
    rf"({_HALF})?"
)
_CONFIG_PARTS = {"sequence", "input", "priors", "tracking", "mapping"}  # of every config.json


@contextmanager
def locked(path: Path | str) -> Iterator[None]:
    """Make a folder, and keep other runs out of it while it is used (not on Windows)."""
    with ExitStack() as stack:
        # RunFolder says what is wrong with a folder that cannot be made or opened.
        with suppress(OSError, ValueError, ImportError):
            import fcntl

            Path(path).mkdir(parents=True, exist_ok=True)
            stack.callback(os.close, folder := os.open(path, os.O_RDONLY))
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                found = "another one in it; wait for its end, or choose another --output"
                raise InputError(f"expected {path} for this run alone, found {found}") from None
        yield


class RunFolder:
    """Reads and writes the files of one run. Nothing outside the folder is touched."""

    def __init__(self, path: Path | str) -> None:
        """Refer to an existing run folder."""
        self.path = user_path(path)
        found = f"no folder at {self.path}; give the --output of an earlier run"
        require(os.path.isdir(self.path), "a run folder", found)

    @classmethod
    def create(
        cls,
        path: Path | str,
        overwrite: bool = False,
        inputs: Sequence[Path] = (),  # images that the run reads
        keeps_log: bool = False,  # the same run begins anew
    ) -> RunFolder:
        """Make a run folder; `overwrite` removes what an earlier run wrote there, and only that.

        config.json stays until the run replaces it: it tells that the folder is one of a run.
        """
        path = Path(path)
        files.require_free(path, overwrite)
        for file in _files_of_a_run(path, inputs) if os.path.isdir(path) else ():
            if file.name != CONFIG and not (keeps_log and file.name == LOG):
                _remove(file)
        for folder in (KEYFRAMES, PLOTS):
            files.make_folder(path / folder)
        return cls(path)

    def write_lost_frames(self, lost: list[tuple[int, float, str]]) -> None:
        """Write (frame_index, timestamp [s], reason); the index is -1 if there is no image."""
        rows = "".join(f"{index} {stamp:.6f} {reason}\n" for index, stamp, reason in lost)
        files.write_text(self.path / LOST_FRAMES, f"# frame_index timestamp reason\n{rows}")

    def write_mlp(self, state: dict[str, Tensor]) -> None:
        """Write the weights of the uncertainty MLP."""
        import torch

        buffer = io.BytesIO()
        torch.save({name: values.cpu() for name, values in state.items()}, buffer)
        files.atomic_write(self.path / MLP, buffer.getvalue())

    def write_image(self, name: str, png: bytes) -> None:
        """Write a plot, plots/NAME.png, or what a keyframe shows, keyframes/000123_KIND.png."""
        assert _OURS.fullmatch(name), name
        files.atomic_write(self.path / name, png)

    def remove_other_keyframes(self, written: set[str]) -> None:
        """Remove the pictures of keyframes that a run gave up, after it was resumed."""
        for file in self.path.glob(f"{KEYFRAMES}/*"):
            name = f"{KEYFRAMES}/{file.name}"
            is_link = file.resolve() != self.path.resolve() / name
            if _OURS.fullmatch(name) and name not in written and not is_link:
                _remove(file)

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint, which a finished run does not need, and half-written files."""
        (self.path / CHECKPOINT).unlink(missing_ok=True)
        for file in self.path.rglob("*.tmp"):
            if _OURS.fullmatch(file.relative_to(self.path).as_posix()):
                file.unlink()

    def read_config(self) -> files.Json:
        """Return sequence, input, priors and settings."""
        return files.read_json(self.path / CONFIG)

    def read_run(self) -> files.Json:
        """Return version, seed, command, timings and exit state."""
        return files.read_json(self.path / RUN)

    def read_metrics(self) -> files.Json:
        """Return the errors against the ground truth."""
        return files.read_json(self.path / METRICS)

    def read_trajectory(self) -> Trajectory:
        """Return the poses of all tracked frames."""
        from minislam.data.trajectory import read_trajectory

        return read_trajectory(self.path / TRAJECTORY)

    def read_mlp(self) -> dict[str, Tensor]:
        """Return the weights of the uncertainty MLP."""
        import torch

        content = io.BytesIO(files.read_bytes(self.path / MLP))
        try:
            return torch.load(content, weights_only=True)
        except Exception as error:  # damaged bytes fail inside torch in many ways
            wanted = f"the weights of the MLP in {self.path / MLP}"
            raise InputError(f"expected {wanted}, found other content; repeat the run") from error


def _remove(file: Path) -> None:
    try:
        file.unlink()
    except OSError as error:
        advice = "choose another --output, or change its permissions"
        raise InputError(f"expected to remove {file}, but: {error.strerror}; {advice}") from error


def _files_of_a_run(path: Path, inputs: Sequence[Path]) -> list[Path]:
    """Return the files that a run wrote into a folder, or refuse a folder that may be another's."""
    entries = [*path.iterdir(), *path.glob(f"{KEYFRAMES}/*"), *path.glob(f"{PLOTS}/*")]
    is_ours = all(_BEGUN.fullmatch(entry.name) for entry in entries)
    with suppress(InputError, TypeError):
        is_ours = is_ours or _CONFIG_PARTS <= set(files.read_json(path / CONFIG))
    wrong = [e for e in entries if e.is_symlink() and e.name in (*_FILES, KEYFRAMES, PLOTS)]
    wrong += [i for i in inputs if i.resolve().is_relative_to(path.resolve())]
    wanted = "the folder of an earlier run for --overwrite"
    without = "without links and without images of this one"
    found = f"{[*wrong, path][0]}; nothing was removed, choose another --output"
    require(is_ours and not wrong, f"{wanted}, {without}", found)
    plain = [entry for entry in entries if entry.is_file() and not entry.is_symlink()]
    return [file for file in plain if _OURS.fullmatch(file.relative_to(path).as_posix())]
