"""Read sequences; read and write trajectories, maps and run folders.

A name is imported when it is first used, because most of them need torch, which takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minislam.data.options import InputOptions
    from minislam.data.ply import GaussianArrays
    from minislam.data.run_folder import RunFolder
    from minislam.data.sequence import RecordedSequence, open_sequence

_MODULES = {
    "InputOptions": "options",
    "GaussianArrays": "ply",
    "RunFolder": "run_folder",
    "RecordedSequence": "sequence",
    "open_sequence": "sequence",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
