"""The command line: `minislam demo | run | eval | doctor`.

Exit codes: 0 all is well, 1 a known error (one sentence), 2 wrong usage, 3 finished but part of
the sequence was lost, 130 interrupted with everything so far written.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import minislam
from minislam.cli_eval import add_eval_parser
from minislam.cli_progress import ProgressLine, StopRequest
from minislam.errors import MinislamError

if TYPE_CHECKING:
    from minislam.config import SlamConfig
    from minislam.data import InputOptions

DEMO_SEQUENCE, DEMO_FRAMES = "synth:crowd", 60
FAILED_EXIT, USAGE_EXIT, INTERRUPTED_EXIT = 1, 2, 130
MAX_SELF_TEST_ERROR = 0.1  # px


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    # What OpenCV and FFmpeg would print about a damaged file, our own sentence says better.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    args, unknown = _parser(arguments).parse_known_args(arguments)
    if unknown:
        print(f"minislam: {_unknown_option(unknown[0], args)}", file=sys.stderr)
        return USAGE_EXIT
    try:
        return args.run(args)
    except MinislamError as error:
        print(f"minislam: {error}", file=sys.stderr)
        return FAILED_EXIT
    except KeyboardInterrupt:
        print("minislam: interrupted", file=sys.stderr)
        return INTERRUPTED_EXIT


def _unknown_option(found: str, args: argparse.Namespace) -> str:
    settings = [name.replace("set:", "--") for name in vars(args) if name.startswith("set:")]
    near = difflib.get_close_matches(found.partition("=")[0], settings, n=1)
    hint = f"the nearest setting is {near[0]}" if near else "see minislam COMMAND --help"
    return f"expected a known option, found {found}; {hint}"


def _parser(arguments: list[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="minislam",
        description="Monocular Gaussian-splatting SLAM for scenes with moving objects.",
    )
    parser.add_argument("--version", action="version", version=f"minislam {minislam.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo",
        help="make a synthetic clip with moving people and run everything on it",
        usage="minislam demo [-o OUTPUT] [options]",
        allow_abbrev=False,
    )
    demo.add_argument("-o", "--output", default="output/demo", help="run folder, output/demo")
    demo.set_defaults(run=_demo, sequence=DEMO_SEQUENCE, overwrite=True, depth="simulated")

    run = commands.add_parser(
        "run",
        help="run SLAM on a video, an image folder or a benchmark",
        usage="minislam run SEQUENCE [-o OUTPUT] [options]",
        allow_abbrev=False,  # half a setting's name might be another setting tomorrow
    )
    run.add_argument("sequence", help="video file, image folder, TUM folder or synth:NAME[:SEED]")
    run.add_argument("-o", "--output", help="run folder, default output/NAME_TIME")
    run.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    _add_input(run)
    run.set_defaults(run=_run)
    for command in (demo, run):
        # Settings need torch, which takes seconds to import: only who runs something waits.
        if arguments and arguments[0] in ("run", "demo"):
            _add_settings(command)

    add_eval_parser(commands)
    doctor = commands.add_parser("doctor", help="say what is installed and whether it works")
    doctor.set_defaults(run=_doctor)
    return parser


def _add_input(parser: argparse.ArgumentParser) -> None:
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
    group.add_argument(
        "--depth",
        help="depth prior: none, simulated (synthetic sequences), sensor, files:FOLDER; "
        "default simulated for synth:, else none",
    )


def _add_settings(parser: argparse.ArgumentParser) -> None:
    from minislam.config import PRESETS, SlamConfig, meanings_of, settings_of

    parser.add_argument("--preset", default="laptop", help=f"{', '.join(PRESETS)}; laptop")
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


def _settings(args: argparse.Namespace) -> SlamConfig:
    """Return the configuration: preset, then file, then single settings, each over the last."""
    from minislam.config import flattened, preset, with_settings
    from minislam.data.files import read_json

    config = preset(args.preset)
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


def _demo(args: argparse.Namespace) -> int:
    from minislam.data import InputOptions

    return _run_with(args, InputOptions(max_frames=DEMO_FRAMES), args.output)


def _run(args: argparse.Namespace) -> int:
    from minislam.data import InputOptions

    names = ("stride", "start", "max_frames", "size", "fx", "fy", "cx", "cy", "calibration")
    options = InputOptions(
        depth_scale=args.depth_scale, **{name: getattr(args, name) for name in names}
    )
    return _run_with(args, options, args.output)


def _run_with(args: argparse.Namespace, options: InputOptions, output: str | None) -> int:
    with StopRequest() as stop:
        return _run_until(stop, args, options, output)


def _run_until(
    stop: StopRequest, args: argparse.Namespace, options: InputOptions, output: str | None
) -> int:
    from minislam.data import RunFolder, open_sequence
    from minislam.run import choose_depth, run_sequence

    config = _settings(args)
    progress = ProgressLine()

    def report(stage: str, done: int, of_all: int) -> None:
        progress.show(stage, done, of_all)
        stop.check()

    sequence = open_sequence(
        args.sequence, options, lambda done, of_all: report("making frames", done, of_all)
    )
    depth = args.depth or ("simulated" if args.sequence.startswith("synth:") else "none")
    output = output or f"output/{sequence.name}_{time.strftime('%Y%m%d-%H%M%S')}"
    print(sequence.description)
    for warning in sequence.warnings:
        print(f"WARNING: {warning}", file=sys.stderr)
    choose_depth(depth, sequence, config)  # a wrong name must not cost an earlier run its files
    folder = RunFolder.create(output, args.overwrite)
    outcome = run_sequence(sequence, config, depth, folder, report)
    print(f"{outcome.state}:")
    for name, value in outcome.metrics.items():
        print(f"  {name:22s} {'unknown' if value is None else f'{value:.3f}'}")
    for warning in outcome.warnings:
        if warning not in sequence.warnings:
            print(f"WARNING: {warning}", file=sys.stderr)
    print(f"results in {folder.path}; open {folder.path}/report.html")
    return outcome.exit_code


def _doctor(args: argparse.Namespace) -> int:
    """Print versions and threads, and measure a flow that is known."""
    import platform

    import torch

    print(f"minislam {minislam.__version__}, Python {platform.python_version()}")
    for name in ("numpy", "scipy", "torch", "cv2", "matplotlib"):
        print(f"  {name:11s} {importlib.import_module(name).__version__}")
    print(f"  processors  {os.cpu_count()}, torch uses {torch.get_num_threads()} threads")
    print(f"  CUDA        {torch.cuda.get_device_name() if torch.cuda.is_available() else 'none'}")
    start = time.perf_counter()
    error = _self_test()
    seconds = time.perf_counter() - start
    print(f"  self-test   flow of a shifted image, off by {error:.3f} px, {seconds:.1f} s")
    if not error <= MAX_SELF_TEST_ERROR:
        raise MinislamError(
            f"expected the self-test to be exact to {MAX_SELF_TEST_ERROR} px, found "
            f"{error:.3f} px; reinstall opencv-python-headless"
        )
    return 0


def _self_test() -> float:
    """Return the error of the flow between an image and the same image shifted [px]."""
    import torch

    from minislam.priors.flow import ClassicalFlow

    source = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 32, 42, generator=source)
    smooth = torch.nn.functional.interpolate(coarse, scale_factor=8, mode="bicubic")
    image = smooth[0].permute(1, 2, 0).clamp(0, 1)
    _, matches = ClassicalFlow().start_chain(image[:240, :320]).advanced(image[4:244, 8:328])
    rows, columns = matches.targets.shape[1:3]
    start = torch.stack(
        torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1
    )
    flow = matches.targets[0] - 8 * start
    middle = flow[8:-8, 8:-8].reshape(-1, 2).median(0).values
    return float((middle - torch.tensor([-8.0, -4.0])).norm())


if __name__ == "__main__":
    sys.exit(main())
