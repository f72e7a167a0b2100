"""The sub-command `minislam priors`: features and depth of every frame, written to files.

Heavy networks then run once, on a machine with a GPU, and `minislam run --features files:DIR
--depth files:DIR` reads their results on any machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from minislam.cli import options
from minislam.cli.help import add_command
from minislam.data.files import atomic_file, make_folder, read_text, write_text
from minislam.errors import require
from minislam.parameters import user_path
from minislam.priors.names import PriorChoice
from minislam.runs.progress import ProgressLine, quoted

if TYPE_CHECKING:
    from torch import Tensor

    from minislam.config import SlamConfig
    from minislam.data.sequence import RecordedSequence
    from minislam.records import Frame


def add_parser(commands: argparse._SubParsersAction) -> None:
    what = "write features and depth of every frame to files, to run SLAM on elsewhere"
    usage = "SEQUENCE --out DIR [--features NAME] [--depth NAME]"
    parser = add_command(commands, "priors", what, usage, epilog=None)
    what = "gets the folders features and depth"
    parser.add_argument("--out", required=True, metavar="DIR", help=what)
    options.add_settings(parser)
    options.add_input(parser)
    options.add_priors(parser, depth="none")
    for action in parser._actions:  # what is shared with run, but changes nothing here
        if action.dest in ("no_uncertainty", "checkpoint_fraction", "masks"):
            action.help = argparse.SUPPRESS
    parser.set_defaults(run=_priors)


def _priors(args: argparse.Namespace) -> None:
    source, inputs = options.source_of(args), options.input_options(args)
    choice = options.prior_choice(args, "none")
    with_features = args.features is not None or choice.features != PriorChoice.features
    is_named = with_features or choice.depth != "none"
    require(is_named, "--features or --depth", "neither; name at least one to write")
    import torch

    from minislam.data.sequence import open_sequence

    config, progress = options.settings(args), ProgressLine()
    torch.set_num_threads(config.threads)
    sequence = open_sequence(source, inputs, partial(progress.show, "making frames"))
    print(sequence.description)
    out = user_path(args.out)
    kinds = list(_kinds(choice, with_features, sequence, config))
    for kind, origin, compute in kinds:
        _write_kind(out / kind, origin, sequence, compute, progress)
    flags = (f"--{kind} {quoted(f'files:{out}')}" for kind, *_ in kinds)
    print(f"use them with {' '.join(flags)}")


def _kinds(
    choice: PriorChoice, with_features: bool, sequence: RecordedSequence, config: SlamConfig
) -> Iterator[tuple[str, str, Callable[[Frame], Tensor | None]]]:
    """Yield the folders to write: name, a line that identifies the content, function of a frame."""
    from minislam.priors.choice import choose_depth, choose_features
    from minislam.priors.features import HighResolutionFeatures
    from minislam.priors.files import DEPTH, FEATURES

    # Everything the result depends on, so that files of another command are not taken for these.
    tree = asdict(config)
    constants = {name: tree[name] for name in ("seed", "networks")}
    conditions = (
        f"{choice.precision} on {choice.device}; {sequence.description}; {sequence.camera}; "
        f"{sequence.opened_as}; {constants}"
    )
    if with_features:
        features = choose_features(choice, sequence.camera, config.networks)
        factor = config.uncertainty.grid_factor
        origin = f"{choice.features} {choice.features_weights}, grid {factor}; {conditions}"
        yield FEATURES, origin, HighResolutionFeatures(features, factor)
    if choice.depth != "none":
        depth = choose_depth(choice, sequence, config.seed, config.networks)
        origin = f"{choice.depth} {choice.depth_weights}; {conditions}"
        yield DEPTH, origin, lambda frame: depth(frame, sequence.camera)


def _write_kind(
    folder: Path,
    origin: str,  # one line
    sequence: RecordedSequence,
    compute: Callable[[Frame], Tensor | None],
    progress: ProgressLine,
) -> None:
    """Write one .npy file per frame. Files of an interrupted call are kept and not made again."""
    import numpy as np

    from minislam.priors.files import INDEX, index_text

    index = index_text(origin, [(frame.frame_index, frame.timestamp) for frame in sequence])
    make_folder(folder)
    path = folder / INDEX
    is_ours = not any(folder.iterdir()) or (path.exists() and read_text(path) == index)
    found = f"{folder} with other files; choose another --out"
    require(is_ours, "an empty folder, or one of the same command", found)
    write_text(path, index)
    for frame in progress.over(f"writing {folder.name}", sequence, len(sequence)):
        path = folder / f"{frame.frame_index:05d}.npy"  # as WildGS-SLAM names its own
        values = None if path.exists() else compute(frame)
        if values is not None:
            with atomic_file(path) as file:
                np.save(file, values.float().cpu().numpy())
