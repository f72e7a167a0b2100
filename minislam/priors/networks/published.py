"""The official checkpoint files, listed in weights.csv, and where `minislam weights` puts them."""

import csv
import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PublishedFile:
    """A row of weights.csv."""

    name: str  # in `minislam weights fetch NAME`; the one that a run takes is called as its network
    use: str  # the flag it is for, like "--flow droid"
    file: str  # its official name
    megabytes: str
    sha256: str  # "" where none is published
    licence: str  # the stricter one where two are stated
    url: str

    @property
    def path(self) -> Path:
        """Return where this file is, or would be, below $MINISLAM_CACHE or ~/.cache/minislam."""
        root = Path(os.environ.get("MINISLAM_CACHE") or Path.home() / ".cache" / "minislam")
        return root / "weights" / self.file


def published_files() -> dict[str, PublishedFile]:
    """Return all rows by their names."""
    text = Path(__file__).with_name("weights.csv").read_text(encoding="utf-8")
    return {row["name"]: PublishedFile(**row) for row in csv.DictReader(text.splitlines())}


def find_weights(use: str, given: str | None) -> str | None:
    """Return the path of what a flag like "--flow droid" reads, if it was given or fetched.

    What was given is a path, or the name of a row.
    """
    row = published_files().get(given or use.split()[-1])
    if row is None or row.use != use or not (given or row.path.exists()):
        return given
    return str(row.path)
