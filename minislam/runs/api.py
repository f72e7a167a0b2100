"""The Python interface: `run`, `load`, `open_sequence`, as in `import minislam; minislam.run(...)`.

Stable from version to version: the names in `minislam.__all__`, the public attributes of `Run`,
and the files of a run folder. Everything else may move.
"""

from collections.abc import Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import cv2

from minislam.config import preset as preset_of
from minislam.config import settings_of, with_settings
from minislam.data.options import InputOptions, default_depth
from minislam.data.sequence import open_sequence
from minislam.errors import InputError, nearest
from minislam.parameters import user_path, with_values
from minislam.priors.choice import PriorChoice
from minislam.runs.loaded import Run
from minislam.runs.progress import ProgressLine, SilentProgress, ending_signals
from minislam.runs.run import default_output, plan_of, run_in_folder

_INPUTS, _PRIORS = vars(InputOptions()).keys(), vars(PriorChoice()).keys()  # names of options


def run(
    source: str | Path,  # video, image folder, TUM folder, or synth:NAME[:SEED]
    output: str | Path | None = None,  # run folder; output/NAME_TIME
    *,
    preset: str = "laptop",
    settings: Mapping[str, Any] | None = None,  # by their names with dots: minislam settings
    overwrite: bool = False,  # replace an earlier run in `output`
    quiet: bool = False,  # no progress on stderr
    workers: int | None = None,  # processes; as many as there are idle cores, at most 4
    **options: Any,  # as on the command line: stride, max_frames, fx, depth, device, ...
) -> Run:
    """Run SLAM on a sequence, write its folder and return the run, as `minislam run` does.

    The process is left as it was, but for the current folder in sys.path, where `python:` priors
    are found. Raises `MinislamError` where the command would end with a sentence. An interrupt
    (Ctrl-C, the square of a notebook) ends after the present step, and what is known by then is
    returned; before there is a map (without a depth prior, until the last stages),
    KeyboardInterrupt is raised and says how to go on.
    """
    given = {n: str(value) if isinstance(value, Path) else value for n, value in options.items()}
    inputs = {name: value for name, value in given.items() if name in _INPUTS}
    priors = {name: value for name, value in given.items() if name in _PRIORS}
    for name in options.keys() - _INPUTS - _PRIORS:
        hint = nearest(name, sorted(_INPUTS | _PRIORS), "see help(minislam.run)")
        if name in settings_of(preset_of(preset)):
            hint = f"it is a setting: settings={ {name: options[name]} }"
        raise InputError(f"expected a known option, found {name}; {hint}")
    from_files = {"uncertainty.given_masks": True} if inputs.get("masks") else {}
    config = with_settings(preset_of(preset), from_files | dict(settings or {}))
    choice = with_values(PriorChoice(depth=default_depth(str(source))), priors)
    sequence = open_sequence(str(source), with_values(InputOptions(), inputs))
    output = user_path(output or default_output(sequence))
    progress = SilentProgress() if quiet else ProgressLine()
    progress.plan = plan_of(config, choice, sequence)
    with closing(progress), ending_signals(progress.interrupt), ExitStack() as after:
        after.callback(cv2.setNumThreads, cv2.getNumThreads())  # the flow sets it
        parts = sequence, config, choice, output, progress
        _, facts = run_in_folder(*parts, overwrite=overwrite, workers=workers)
        for warning in facts["warnings"]:
            if warning not in progress.warned:
                progress.warn(warning)
    return Run(output)


def load(folder: str | Path) -> Run:
    """Return a run that was written earlier, with all that is needed to render its map."""
    return Run(folder)


__all__ = ["InputOptions", "Run", "load", "open_sequence", "run"]
