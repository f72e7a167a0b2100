"""Go on with an interrupted run: when its state is written, and when it is accepted."""

import functools
import json
import time
from dataclasses import asdict
from typing import Any
from zlib import crc32

import minislam
from minislam.config import SlamConfig, as_json, flattened
from minislam.data import RunFolder
from minislam.errors import InputError
from minislam.priors.choice import PriorChoice
from minislam.records import Sequence
from minislam.slam import Slam


class Checkpoints:
    """Keeps the state of a run in its folder, as often as a small share of the time allows."""

    def __init__(
        self, folder: RunFolder, sequence: Sequence, config: SlamConfig, choice: PriorChoice
    ) -> None:
        self.seconds = 0.0  # spent on writing
        self.problem: str | None = None  # why the last one could not be written
        self._folder, self._share = folder, config.checkpoint_share
        self._origin = _origin(sequence, config, choice)
        self._start = self._last = time.perf_counter()
        self._cost = 0.0  # of the last one [s]

    @property
    def run_seconds(self) -> float:
        """Return how long the run has taken, interrupted parts included."""
        return time.perf_counter() - self._start

    def keep(self, slam: Slam, at_all_events: bool) -> None:
        """Write a checkpoint if it is time for one; a disk that is full ends no run."""
        begun = time.perf_counter()
        is_due = begun - self._last >= self._cost / self._share if self._share > 0 else False
        if self._share <= 0 or not (is_due or at_all_events):
            return
        times = {"run_seconds": self.run_seconds, "checkpoint_seconds": self.seconds}
        try:
            self._folder.write_checkpoint(self._origin | times | {"slam": slam.saved_state()})
            self.problem = None
        except InputError as error:
            self.problem = f"the last checkpoint is older than this state: {error}"
        self._last = time.perf_counter()
        self._cost = self._last - begun
        self.seconds += self._cost

    def restore(self, slam: Slam) -> None:
        """Take up the state in the folder, if it belongs to the same run."""
        found = self._folder.read_checkpoint()
        then = flattened({name: found.get(name) for name in self._origin})
        for name, now in flattened(self._origin).items():
            if then.get(name) != now:
                raise InputError(
                    f"expected {name} = {then.get(name)} like the interrupted run in "
                    f"{self._folder.path}, found {now}; repeat its command with --resume, or start "
                    "anew in another folder"
                )
        slam.restore_state(found["slam"], functools.cache(slam.sequence.frame))
        self._start -= found["run_seconds"]
        self.seconds = found["checkpoint_seconds"]


def _origin(sequence: Sequence, config: SlamConfig, choice: PriorChoice) -> dict[str, Any]:
    """Return what must be the same for a run to go on, as JSON gives it back."""
    origin = {
        "version": minislam.__version__,
        "sequence": {
            "name": sequence.name,
            "description": sequence.description,
            "frames": len(sequence),
            "camera": asdict(sequence.camera),
            "first_image": crc32(sequence.frame(0).image.numpy().tobytes()),
        },
        "priors": asdict(choice),
        "settings": as_json(config),
    }
    return json.loads(json.dumps(origin))
