"""WildGS-SLAM in plain Python: monocular Gaussian-splatting SLAM for scenes with moving objects.

    run = minislam.run("my.mp4", stride=2)    # also: minislam.load("output/my")
    run                                       # in a notebook: facts and an overview
    run.plot(); run.view()                    # a figure; the map to turn with the mouse
    run.render(run.poses[40])                 # (H, W, 3), the static scene from any pose

To read, begin with `Slam.run` in slam.py, the whole system on one screen.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minislam.runs.api import InputOptions, Run, load, open_sequence, run

__version__ = "0.2.0"
__all__ = ["InputOptions", "Run", "__version__", "load", "open_sequence", "run"]


if not TYPE_CHECKING:  # a type checker would take it for a promise of every name

    def __getattr__(name: str) -> Any:
        """Import the interface when it is used first: torch alone takes seconds."""
        if name not in __all__:
            raise AttributeError(f"module 'minislam' has no attribute {name!r}")
        return getattr(import_module("minislam.runs.api"), name)


def __dir__() -> list[str]:
    return __all__
