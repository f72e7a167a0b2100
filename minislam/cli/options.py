"""What several commands can be told: which frames, which priors, which settings.

Whatever needs torch is imported where it is used: `--help` answers at once.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from minislam.config import SlamConfig
    from minislam.data import InputOptions
    from minislam.evaluation.lpips import Lpips
    from minislam.geometry import Camera
    from minislam.priors.choice import PriorChoice

_INPUT = ("stride", "start", "max_frames", "size", "fx", "fy", "cx", "cy", "calibration")
_PRIORS = (
    "flow", "flow_weights", "features", "features_weights", "depth", "depth_weights", "device"
)  # fmt: skip


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which frames to read, with which camera."""
    parser.add_argument(
        "sequence", help="video file, image folder, TUM folder or synth:NAME[:SEED]"
    )
    group = parser.add_argument_group("input")
    group.add_argument("--stride", type=int, default=1, help="use every n-th frame, 1")
    group.add_argument("--start", type=int, default=0, help="first frame to use, 0")
    group.add_argument("--max-frames", type=int, help="number of frames at most, all")
    group.add_argument("--size", type=_size, help="working size WIDTHxHEIGHT, about 320x240")
    for name in ("fx", "fy", "cx", "cy"):
        group.add_argument(f"--{name}", type=float, help="of the raw images [px]")
    group.add_argument("--calibration", help="file: fx fy cx cy [width height [k1 k2 p1 p2 k3]]")
    group.add_argument(
        "--depth-scale", type=float, default=5000, help="depth units per metre, 5000"
    )


def add_priors(parser: argparse.ArgumentParser, default_depth: str) -> None:
    """Add the options that say what is known of an image before any geometry.

    Names are checked later, with the weights: what is wrong is then one sentence.
    """
    group = parser.add_argument_group(
        "priors", "networks need their official checkpoints, see README.md for where to get them"
    )
    group.add_argument(
        "--features", help="classical, dinov2, fit3d or files:FOLDER; default classical"
    )
    group.add_argument("--features-weights", metavar="FILE", help="checkpoint of dinov2 or fit3d")
    group.add_argument(
        "--depth",
        help="none, simulated (synthetic sequences), sensor, metric3d, depth-anything or "
        f"files:FOLDER; default {default_depth}",
    )
    group.add_argument(
        "--depth-weights", metavar="FILE", help="checkpoint of metric3d or depth-anything"
    )
    group.add_argument("--device", help="where networks run: cpu or cuda; cpu")


def add_flow(parser: argparse.ArgumentParser) -> None:
    """Add the options of the flow, which only a run needs."""
    group = parser.add_argument_group("flow")
    group.add_argument("--flow", help="classical or droid; default classical")
    group.add_argument("--flow-weights", metavar="FILE", help="checkpoint of droid")


def add_lpips(parser: argparse.ArgumentParser) -> None:
    """Add the files of LPIPS, a measure for which nothing comes with the package."""
    group = parser.add_argument_group("LPIPS", "measured if both files are given")
    group.add_argument("--lpips-trunk", metavar="FILE", help="torchvision's AlexNet or VGG-16")
    group.add_argument("--lpips-heads", metavar="FILE", help="the authors' alex.pth or vgg.pth")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add presets, and every constant of the system under its name. This needs torch."""
    from minislam.config import PRESETS, SlamConfig, meanings_of, settings_of

    parser.add_argument("--preset", help=f"{', '.join(PRESETS)}; laptop")
    parser.add_argument("--config", help="JSON file of settings, like config.json of a run")
    parser.add_argument("--seed", type=int, help="of every random draw, 0")
    parser.add_argument(
        "--no-uncertainty", action="store_true", help="trust every pixel alike (ablation)"
    )
    group = parser.add_argument_group("settings", "every constant by its name, with its default")
    meanings = meanings_of(SlamConfig())
    for name, value in settings_of(SlamConfig()).items():
        if name == "seed":
            continue
        shown = ",".join(map(str, value)) if isinstance(value, tuple) else value
        meaning = f"{meanings[name]}; {shown}".replace("%", "%%")
        group.add_argument(f"--{name}", dest=f"set:{name}", metavar="VALUE", help=meaning)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT like 320x240, found {text!r}")
    return int(width), int(height)


def input_options(args: argparse.Namespace) -> InputOptions:
    """Return what `add_input` was told."""
    from minislam.data import InputOptions

    given = {name: getattr(args, name) for name in _INPUT}
    return InputOptions(depth_scale=args.depth_scale, **given)


def prior_choice(args: argparse.Namespace, default_depth: str) -> PriorChoice:
    """Return what `add_priors` and `add_flow` were told; a command may lack some of it."""
    from minislam.priors.choice import PriorChoice

    given = {name: getattr(args, name, None) for name in (*_PRIORS, "depth_scale")}
    given["depth"] = given["depth"] or default_depth
    return PriorChoice(**{name: value for name, value in given.items() if value is not None})


def lpips_of(args: argparse.Namespace, camera: Camera) -> Lpips | None:
    """Return the measure whose files were given, if it can be taken at this size of images."""
    from minislam.errors import InputError
    from minislam.runs.run import load_lpips

    trunk, heads = getattr(args, "lpips_trunk", None), getattr(args, "lpips_heads", None)
    if trunk is None and heads is None:
        return None
    if trunk is None or heads is None:
        missing, given = ("heads", "trunk") if heads is None else ("trunk", "heads")
        raise InputError(
            f"expected --lpips-{missing} FILE with --lpips-{given}, found none; give both or none"
        )
    lpips = load_lpips(trunk, heads)
    lpips.require_size(camera.width, camera.height)
    return lpips


def settings(args: argparse.Namespace, then: SlamConfig | None = None) -> SlamConfig:
    """Return the configuration: preset, then file, then single settings, each over the last.

    Of a run that goes on, `then` is its configuration: in the place of a preset that is not given.
    """
    from minislam.config import flattened, preset, with_settings
    from minislam.data.files import read_json

    config = then if then and args.preset is None else preset(args.preset or "laptop")
    if args.config:
        config = with_settings(config, flattened(read_json(args.config)))
    given = {
        name.removeprefix("set:"): value
        for name, value in vars(args).items()
        if name.startswith("set:") and value is not None
    }
    if args.seed is not None:
        given["seed"] = args.seed
    if args.no_uncertainty:
        given["uncertainty.enabled"] = False
    return with_settings(config, given)


def resumed_settings(args: argparse.Namespace, output: str) -> SlamConfig:
    """Return the configuration of an interrupted run, which the options must not contradict."""
    from minislam.config import from_json, settings_of
    from minislam.data import RunFolder
    from minislam.errors import InputError

    then = from_json(RunFolder(output).read_config())
    now = settings_of(settings(args, then))
    for name, value in settings_of(then).items():
        if now[name] != value:
            raise InputError(
                f"expected {name} = {value} like the interrupted run in {output}, found "
                f"{now[name]}; leave the settings out, or start anew in another folder"
            )
    return then
