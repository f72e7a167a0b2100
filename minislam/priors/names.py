"""Which priors there are, by the values of --flow, --features and --depth. This needs no torch.

The official checkpoints are listed in networks/weights.csv; `minislam weights` fetches them.
"""

import csv
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from minislam.errors import InputError, require
from minislam.parameters import FILES, absolute_path, user_path

PYTHON = "python:"  # before MODULE:FACTORY
FOLDER = f"{FILES}FOLDER"
PRECISIONS = {"fp32": "float32", "bf16": "bfloat16", "fp16": "float16"}  # names of torch
BUILT_IN = {
    "flow": ("classical",),
    "features": ("classical", FOLDER),
    "depth": ("none", "simulated", "sensor", FOLDER),
}


@dataclass(frozen=True)
class PriorChoice:
    """Which priors a run uses: the values of the flags of these names."""

    flow: str = "classical"
    flow_weights: str | None = None
    features: str = "classical"
    features_weights: str | None = None
    depth: str = "none"
    depth_weights: str | None = None
    device: str = "cpu"  # of the whole run, cpu or cuda; what OpenCV does stays on the CPU
    precision: str = "fp32"  # of DROID and of the vision transformers: fp32, bf16 or fp16

    def __post_init__(self) -> None:
        """Refuse a device that is not there, and a precision that it has not."""
        is_known = self.device in ("cpu", "cuda")
        require(is_known, "--device cpu or cuda", f"{self.device!r}; choose one")
        if self.device == "cuda":
            import torch  # only where a GPU is asked for

            advice = "say --device cpu, or make the priors elsewhere with minislam priors"
            wanted = "a GPU that this torch can use for --device cuda"
            require(torch.cuda.is_available(), wanted, f"none; {advice}")
        usable = [name for name in PRECISIONS if (self.device, name) != ("cpu", "fp16")]
        wanted = f"--precision {' or '.join(usable)} with --device {self.device}"
        require(self.precision in usable, wanted, f"{self.precision!r}; choose one")

    def from_anywhere(self) -> "PriorChoice":
        """Return the same choice by absolute paths, which a run folder keeps."""
        found = {}
        for name, value in vars(self).items():
            is_file = name.endswith("_weights") and value and value not in published_files()
            if str(value).startswith(FILES) or (is_file and os.path.exists(absolute_path(value))):
                found[name] = absolute_path(value)
        return replace(self, **found)


@dataclass(frozen=True)
class PublishedFile:
    """A row of weights.csv."""

    name: str  # in `minislam weights fetch NAME`; a run takes the one named like the network
    use: str  # the flag it is for, like "--flow droid"
    file: str  # its official name
    megabytes: str
    sha256: str  # "" where none is published
    licence: str  # the stricter one where two are stated
    url: str

    @property
    def path(self) -> Path:
        """Return where this file is, or would be, below $MINISLAM_CACHE or ~/.cache/minislam."""
        root = os.environ.get("MINISLAM_CACHE") or "~/.cache/minislam"
        return user_path(root) / "weights" / self.file


def published_files() -> dict[str, PublishedFile]:
    """Return all rows by their names."""
    text = (Path(__file__).parent / "networks/weights.csv").read_text(encoding="utf-8")
    return {row["name"]: PublishedFile(**row) for row in csv.DictReader(text.splitlines())}


def find_weights(use: str, given: str | None) -> str | None:
    """Return the file of "--flow droid": the given path or name's, else the fetched one, if any."""
    row = published_files().get(given or use.split()[-1])
    if row is None or row.use != use or not (given or row.path.exists()):
        return given
    return str(row.path)


def plugins(kind: str) -> dict[str, Any]:
    """Return the entry points by which installed packages name priors of a kind."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group=f"minislam.{kind}")}


def require_prior(kind: str, name: str, weights: str | None) -> str | None:
    """Return the file that --KIND NAME reads, None if it needs none.

    Refuse a name that is unknown and weights that are missing, before anything is loaded.
    """
    uses = dict.fromkeys(row.use for row in published_files().values())
    learned = [use.split()[1] for use in uses if use.startswith(f"--{kind} ")]
    if name in learned:
        file = find_weights(f"--{kind} {name}", weights)
        wanted = f"--{kind}-weights FILE with --{kind} {name}"
        found = "none" if file is None else f"nothing at {file}"
        fetch = f"fetch it with minislam weights fetch {name}"
        advice = f"{fetch}, or give the path of an official checkpoint"
        require(file is not None and user_path(file).is_file(), wanted, f"{found}; {advice}")
        return file
    if name.startswith(PYTHON) or name in plugins(kind):
        return weights
    wanted = f"--{kind} {' or '.join(learned)} with --{kind}-weights"
    require(weights is None, wanted, f"--{kind} {name}; name the network of {weights}")
    if name.startswith(FILES) and FOLDER in BUILT_IN[kind]:
        folder = user_path(name.removeprefix(FILES))
        found = f"nothing at {folder}; check the path"
        require(folder.is_dir(), f"a folder of {kind} files", found)
    elif name not in BUILT_IN[kind]:
        known = ", ".join([*BUILT_IN[kind], *learned, *plugins(kind)])
        wanted = f"--{kind} {known} or {PYTHON}MODULE:FUNCTION"
        raise InputError(f"expected {wanted}, found {name!r}; choose one")
    return None
