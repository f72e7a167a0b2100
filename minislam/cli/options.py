"""Options that several commands share: which frames, which priors, which settings.

Whatever needs torch is imported where it is used: `minislam --help` answers at once.
"""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

from minislam.cli.help import UsageError, unknown_option
from minislam.data.files import read_json
from minislam.data.options import InputOptions
from minislam.data.run_folder import CONFIG, METRICS, RUN, RunFolder
from minislam.errors import InputError, require
from minislam.parameters import flattened, kind_of, user_path, with_values
from minislam.priors.names import BUILT_IN, PriorChoice, find_weights, require_prior

if TYPE_CHECKING:
    from minislam.config import SlamConfig
    from minislam.evaluation.lpips import Lpips

Options = TypeVar("Options")  # InputOptions or PriorChoice
PRESETS = ("laptop", "paper", "paper-fast", "test")  # of minislam.config, which needs torch


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add the sequence, and a flag for every field of InputOptions."""
    what = "video file, image folder, TUM folder or synth:NAME[:SEED]; default: that of --config"
    parser.add_argument("sequence", nargs="?", help=what)
    add = parser.add_argument_group("input").add_argument
    for option in fields(InputOptions):
        name, default = option.name, option.default
        what = option.metadata["meaning"] + ("" if default is None else f"; {default}")
        kind, like = (size_of, "WIDTHxHEIGHT") if name == "size" else (kind_of(option), "VALUE")
        add(f"--{name.replace('_', '-')}", type=kind, metavar=like, help=what)


def add_priors(parser: argparse.ArgumentParser, depth: str, with_flow: bool = False) -> None:
    """Add the options for features, depth (its default is given) and, for a run alone, the flow."""
    group = parser.add_argument_group(
        "priors",
        "networks need their official checkpoints: minislam weights list\n"
        "FILE: a path, or a name of that list; default: the name of the network, as metric3d",
    )
    add = group.add_argument
    what = "classical, dinov2, fit3d, files:FOLDER or python:MODULE:FUNCTION; default classical"
    add("--features", help=what)
    add("--features-weights", metavar="FILE", help="checkpoint of dinov2 or fit3d")
    what = "none, simulated (synthetic sequences), sensor, metric3d, depth-anything, files:FOLDER"
    add("--depth", help=f"{what} or python:MODULE:FUNCTION; default {depth}")
    add("--depth-weights", metavar="FILE", help="checkpoint of metric3d or depth-anything")
    add("--device", help="where everything runs: cpu or cuda; cpu")
    add("--precision", help="of the networks: fp32, bf16 or fp16 (cuda); fp32")
    if with_flow:
        add("--flow", help="classical, droid or python:MODULE:FUNCTION; classical")
        add("--flow-weights", metavar="FILE", help="checkpoint of droid")


def add_talk(parser: argparse.ArgumentParser) -> None:
    """Add how much is said, and how many processes share the work."""
    loudness = parser.add_mutually_exclusive_group()
    loudness.add_argument("-q", "--quiet", action="store_true", help="only warnings and errors")
    loudness.add_argument("-v", "--verbose", action="store_true", help="a line for every step")
    what = "processes that share the work, without effect on the result"
    default = "$MINISLAM_WORKERS, or one per idle core, at most 4; on a GPU 1"
    parser.add_argument("--workers", type=int, metavar="N", help=f"{what}; default: {default}")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add --preset and the flags that set many settings; `take_settings` finds those with a dot."""
    parser.set_defaults(takes_settings=True)
    add = parser.add_argument
    add("--preset", help=f"{', '.join(PRESETS)}; laptop")
    add("--config", help="JSON file of settings; config.json of a run repeats it")
    add("--seed", help="seed of every random draw, 0")
    add("--threads", help="threads of torch, 1")
    add("--checkpoint_fraction", help="see minislam settings checkpoint; 0.01")
    add("--no-uncertainty", action="store_true", help="all weights 1, no second adjustment")


def take_settings(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Return what is no setting, and the values of settings like --tracking.window 8 by name.

    Names with a dot are settings. Which of them there are is known only with torch.
    """
    behind = arguments[arguments.index("--") + 1 :] if "--" in arguments else []
    if len(behind) > 1:
        raise UsageError(f"expected one name after --, found also {behind[1]}; put options first")
    others: list[str] = []
    given: dict[str, str] = {}
    todo = iter(arguments)
    for argument in todo:
        if argument == "--":
            return [*others, argument, *todo], given
        name, equals, value = argument.partition("=")
        if name.startswith("--") and "." in name:
            if not equals and re.match("--?[a-z]|$", value := next(todo, "")):
                raise UsageError(f"expected a value after {name}, found none; give one")
            given[name.removeprefix("--")] = value
        else:
            others.append(argument)
    return others, given


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of a text like 320x240."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT like 320x240, found {text!r}")
    return int(width), int(height)


def config_file(args: argparse.Namespace) -> dict[str, Any]:
    """Return the file given with --config, or config.json of the run that --resume goes on with."""
    tree: Any = {}
    if args.config:
        path = user_path(args.config)
        is_folder = os.path.isdir(path)  # a name of any length
        wanted = (path if is_folder else path.parent) / CONFIG
        if (is_folder or path.name in (RUN, METRICS)) and wanted.is_file():
            raise InputError(f"expected a file of settings, found {path} of a run; give {wanted}")
        tree = read_json(path)
    elif getattr(args, "resume", False):
        tree = RunFolder(args.output).read_config()
    flattened(tree)  # refuses what is no JSON object
    return tree


def source_of(args: argparse.Namespace) -> str:
    """Return the name of the sequence, from the command line or from the file of --config."""
    source = args.sequence or config_file(args).get("sequence")
    require(bool(source), "a SEQUENCE, or --config FILE that names one", "neither")
    return str(source)


def input_options(args: argparse.Namespace) -> InputOptions:
    """Return the input options: those of the file of --config, replaced by what is given."""
    return _with_given(InputOptions(), args, "input")


def prior_choice(args: argparse.Namespace, default_depth: str) -> PriorChoice:
    """Return the priors, which exist: those of the file of --config, replaced by what is given."""
    choice = _with_given(PriorChoice(depth=default_depth), args, "priors")
    for kind in BUILT_IN:
        require_prior(kind, getattr(choice, kind), getattr(choice, f"{kind}_weights"))
    return choice


def _with_given(options: Options, args: argparse.Namespace, part: str) -> Options:
    """Return options replaced by those of a part of the file of --config, and by the flags."""
    flags = {name: getattr(args, name, None) for name in vars(options)}
    given = {name: value for name, value in flags.items() if value is not None}
    return with_values(options, flattened(config_file(args).get(part, {})) | given)


def lpips_of(args: argparse.Namespace) -> Lpips | None:
    """Return the measure whose files were given, as paths or by their names in the list."""
    files = {f"--lpips-{name}": getattr(args, f"lpips_{name}", None) for name in ("trunk", "heads")}
    missing = [flag for flag, file in files.items() if file is None]
    if len(missing) == 2:
        return None
    if missing:
        [given] = files.keys() - missing
        raise InputError(f"expected {missing[0]} FILE with {given}, found none; give both or none")
    from minislam.evaluation.lpips import Lpips
    from minislam.priors.networks.checkpoints import load_checkpoint

    paths = [user_path(str(find_weights(flag, file))) for flag, file in files.items()]
    return Lpips(*(load_checkpoint(path).as_dict() for path in paths))


def settings(args: argparse.Namespace) -> SlamConfig:
    """Return the settings: the preset, over it the file of --config, over both single flags.

    With --resume, those of the interrupted run stand for the preset if none is given; a run that
    its checkpoint does not belong to is refused by `Checkpoints.restore`.
    """
    from minislam.config import preset, settings_in, settings_of, with_settings

    base = preset("laptop" if args.preset is None else args.preset)
    if getattr(args, "resume", False) and args.preset is None:
        base = with_settings(base, settings_in(RunFolder(args.output).read_config()))
    if args.config:
        base = with_settings(base, settings_in(config_file(args)))
    known, given = settings_of(base), dict(args.settings)
    if unknown := [name for name in given if name not in known]:
        raise unknown_option(f"--{unknown[0]}", args.parser)
    flags = {name: getattr(args, name) for name in known if "." not in name}
    given |= {name: value for name, value in flags.items() if value is not None}
    if args.no_uncertainty:
        given["uncertainty.enabled"] = False
    if getattr(args, "masks", None):
        given.setdefault("uncertainty.given_masks", True)
    return with_settings(base, given)
