"""Whole runs made brief, for tests of what stands around a run: the command line, the run folder.

Every stage is there, with few iterations; how good the results are is no question then. It is the
question of `tests/test_slam.py`, which runs with the real budgets and draws the real plots.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from data_synth import Intrinsics, Scene, SyntheticFrame, render_frame, writing
from minislam.config import PRESETS
from minislam.data.images import encode_png
from minislam.runs import pictures
from minislam.stereo import second_adjustment

BUDGETS = {
    "tracking.warmup_rounds": 1,
    "tracking.warmup_iterations": 3,
    "tracking.pose_iterations": 4,
    "mapping.init_iterations": 5,
    "mapping.keyframe_iterations": 2,
    "mapping.refine_iterations": 5,
}
BLANK = encode_png(np.zeros((2, 2, 3), np.uint8))
_rendered: dict[tuple[Any, ...], SyntheticFrame] = {}


@contextmanager
def brief_runs() -> Iterator[None]:
    """Cut the preset `test`, the images of the second adjustment, and the plots: here alone."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in BUDGETS.items():
            patch.setitem(PRESETS["test"], name, value)
        patch.setattr(second_adjustment, "COARSE_WIDTH", 24)
        with plots_left_out():
            yield


@contextmanager
def plots_left_out() -> Iterator[None]:
    """Write blank plots, which take a fifth of the time of a short run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "figure_png", lambda figure: BLANK)
        yield


@contextmanager
def frames_rendered_once() -> Iterator[None]:
    """Keep every synthetic frame in memory: most tests look at the same few seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "render_frame", render_once)
        yield


def render_once(view: Scene, intrinsics: Intrinsics, index: int, **how: Any) -> SyntheticFrame:
    """Return what `render_frame` returns, which depends on nothing else."""
    key = (view.name, view.seed, intrinsics, index, *how.items())
    if key not in _rendered:
        _rendered[key] = render_frame(view, intrinsics, index, **how)
    return _rendered[key]
