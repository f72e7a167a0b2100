"""A case of `bad_inputs`: a command in a folder of good inputs, one of which is spoilt before."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

REFUSED, WARNED, ACCEPTED, EITHER = "refused", "warned or refused", "accepted", "either"
Spoil = Callable[[Path], object]


@dataclass
class Case:
    """A command in a folder of good inputs, one of which is spoilt before."""

    group: str
    label: str
    command: str
    spoil: Spoil | None = None
    expected: str = REFUSED


RUN = "run {} -o out --preset test --workers 1 -q"


def content(name: str, new: bytes | str) -> Spoil:
    """Return what replaces a file."""
    data = new.encode() if isinstance(new, str) else new
    return lambda folder: (folder / name).write_bytes(data)


def replaced(name: str, make: Callable[[Path], object]) -> Spoil:
    """Return what puts something else in the place of a file."""

    def spoil(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        make(folder / name)

    return spoil
