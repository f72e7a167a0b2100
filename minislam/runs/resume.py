"""Checkpoints of a run: when they are saved, and which run may be resumed from them."""

import functools
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import minislam
from minislam.config import SlamConfig
from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.data.run_folder import CHECKPOINT, RunFolder
from minislam.errors import InputError, MinislamError, require
from minislam.parameters import flattened
from minislam.priors.choice import PriorChoice
from minislam.records import Sequence
from minislam.runs.progress import quoted
from minislam.slam import Slam

NO_WAY_ON = "no checkpoint was written (--checkpoint_fraction 0); start again with --overwrite"


def way_on(folder: Path | str) -> str:
    """Return how to go on with a run, or nothing where it has no checkpoint."""
    command = f"go on with: minislam run --resume -o {quoted(str(folder))}"
    return command if (Path(folder) / CHECKPOINT).is_file() else ""


class Checkpoints:
    """Saves the state of a run in its folder; saving takes a small fraction of the time."""

    def __init__(
        self, folder: RunFolder, sequence: Sequence, config: SlamConfig, choice: PriorChoice
    ) -> None:
        self.seconds = 0.0  # spent on writing
        self.problem: str | None = None  # why the last checkpoint could not be written
        self._folder = folder
        self._fraction = config.checkpoint_fraction
        origin = {
            "version": minislam.__version__,  # another one may have other options
            "input": sequence.opened_as["input"],  # an option says more than a description
            "sequence": {
                "name": sequence.name,
                "description": sequence.description,
                "frames": len(sequence),
                "camera": asdict(sequence.camera),
            },
            "priors": asdict(choice),
            "settings": asdict(config),
        }  # must be the same for a run to be resumed, as it is read back from JSON
        self._origin: dict[str, Any] = json.loads(json.dumps(origin))
        self.start = time.perf_counter()
        self._due = 0.0  # second, when the next checkpoint may be saved

    @property
    def run_seconds(self) -> float:
        """Return how long the run has taken, interrupted parts included."""
        return time.perf_counter() - self.start

    def save(self, slam: Slam, force: bool) -> None:
        """Save a checkpoint if due or forced (not at a fraction of 0); a full disk ends no run."""
        begun = time.perf_counter()
        if self._fraction <= 0 or (begun < self._due and not force):
            return
        tree = self._origin | {
            "run_seconds": self.run_seconds,
            "checkpoint_seconds": self.seconds,
            "checksums": {str(index): sum for index, sum in slam.sequence.checksums.items()},
            "slam": slam.saved_state(),
        }
        try:
            write_checkpoint(self._folder.path / CHECKPOINT, tree)
            self.problem = None
        except InputError as error:
            reason = str(error).partition("; ")[0]  # another folder does not help this run
            self.problem = f"no checkpoint of this state: {reason}; free space"
        ended = time.perf_counter()
        self._due = ended + (ended - begun) / self._fraction
        self.seconds += ended - begun

    def restore(self, slam: Slam) -> None:
        """Restore the state in the folder; refuse that of another run or of other images.

        What a GPU began may go on without one, no longer to the same bytes.
        """
        device, where = self._origin["priors"]["device"], self._folder.path
        found, anew = read_checkpoint(where / CHECKPOINT, device), "start anew in another folder"
        try:
            present = flattened(self._origin)
            then = flattened({name: found.get(name) for name in self._origin})
            if device == "cpu" and then.get("priors.device") != "cpu":
                then |= {name: present[name] for name in ("priors.device", "priors.precision")}
            differing = [name for name, now in present.items() if then.get(name) != now]
            # What else of the input differs shows in the checksums of images, masks and sensor
            # depth. What --depth files: and --features files: read is not compared.
            if any(n[:6] != "input." or n == "input.depth_scale" for n in differing):
                name = differing[0]
                wanted = f"{name} = {then.get(name)} like the interrupted run in {where}"
                how = "repeat its command with --resume"
                if name == "version":
                    how = "resume it with that version"
                raise InputError(f"expected {wanted}, found {present[name]}; {how}, or {anew}")
            for index, checksum in found["checksums"].items():
                slam.sequence.frame(int(index))
                wanted = f"frame {index} as the interrupted run in {where} read it"
                other = f"another image, lens, mask or depth; restore it, or {anew}"
                require(slam.sequence.checksums[int(index)] == checksum, wanted, other)
            slam.restore_state(found["slam"], functools.cache(slam.frame))
            self.start -= float(found["run_seconds"])
            self.seconds = float(found["checkpoint_seconds"])
        except MinislamError:
            raise
        except Exception as error:  # parts are missing, or have another type or shape
            wanted = f"the whole state of a run in {where / CHECKPOINT}"
            found = f"{error!r}: a damaged or another file; remove it, and start again with"
            raise InputError(f"expected {wanted}, found {found} --overwrite") from error
