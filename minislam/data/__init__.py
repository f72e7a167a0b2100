"""Read sequences; read and write trajectories, maps and run folders.

A name is imported when it is first used, because most of them need torch, which takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minislam.data.files import atomic_write
    from minislam.data.options import InputOptions
    from minislam.data.ply import GaussianArrays, read_ply, write_ply
    from minislam.data.run_folder import RunFolder
    from minislam.data.sequence import RecordedSequence, open_sequence
    from minislam.data.trajectory import read_trajectory, write_trajectory

__all__ = [
    "GaussianArrays",
    "InputOptions",
    "RecordedSequence",
    "RunFolder",
    "atomic_write",
    "open_sequence",
    "read_ply",
    "read_trajectory",
    "write_ply",
    "write_trajectory",
]
_MODULES = ("files", "options", "ply", "run_folder", "sequence", "trajectory")


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in map(import_module, (f"{__name__}.{part}" for part in _MODULES)):
            if hasattr(module, name):
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
