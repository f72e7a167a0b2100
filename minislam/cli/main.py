"""The command line: `minislam demo | run | priors | eval | doctor`.

Exit codes: 0 all is well, 1 a known error (one sentence), 2 wrong usage, 3 finished but part of
the sequence was lost, 130 interrupted with everything so far written.
"""

from __future__ import annotations

import argparse
import difflib
import os
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import minislam
from minislam.cli.doctor import add_doctor_parser
from minislam.cli.evaluate import add_eval_parser
from minislam.cli.options import (
    add_flow,
    add_input,
    add_lpips,
    add_priors,
    add_settings,
    input_options,
    lpips_of,
    prior_choice,
    resumed_settings,
    settings,
)
from minislam.cli.priors import add_priors_parser
from minislam.cli.progress import ProgressLine, StopRequest
from minislam.errors import InputError, MinislamError

if TYPE_CHECKING:
    from minislam.data import InputOptions

DEMO_SEQUENCE, DEMO_FRAMES = "synth:crowd", 60
FAILED_EXIT, USAGE_EXIT, INTERRUPTED_EXIT = 1, 2, 130


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
    known = [name.replace("set:", "--") for name in vars(args) if name.startswith("set:")]
    near = difflib.get_close_matches(found.partition("=")[0], known, n=1)
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
    demo.set_defaults(
        run=_demo, sequence=DEMO_SEQUENCE, overwrite=True, resume=False, depth="simulated"
    )

    run = commands.add_parser(
        "run",
        help="run SLAM on a video, an image folder or a benchmark",
        usage="minislam run SEQUENCE [-o OUTPUT] [options]",
        allow_abbrev=False,  # half a setting's name might be another setting tomorrow
    )
    run.add_argument("-o", "--output", help="run folder, default output/NAME_TIME")
    earlier = run.add_mutually_exclusive_group()
    earlier.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    earlier.add_argument(
        "--resume", action="store_true", help="go on with the interrupted run in OUTPUT"
    )
    add_input(run)
    add_priors(run, default_depth="simulated for synth:, else none")
    add_flow(run)
    add_lpips(run)
    run.set_defaults(run=_run)
    priors = add_priors_parser(commands)
    for command in (demo, run, priors):
        # Settings need torch, which takes seconds to import: only who runs something waits.
        if arguments and arguments[0] in ("run", "demo", "priors"):
            add_settings(command)
    add_eval_parser(commands)
    add_doctor_parser(commands)
    return parser


def _demo(args: argparse.Namespace) -> int:
    from minislam.data import InputOptions

    return _run_with(args, InputOptions(max_frames=DEMO_FRAMES), args.output)


def _run(args: argparse.Namespace) -> int:
    return _run_with(args, input_options(args), args.output)


def _run_with(args: argparse.Namespace, options: InputOptions, output: str | None) -> int:
    with StopRequest() as stop:
        return _run_until(stop, args, options, output)


def _run_until(
    stop: StopRequest, args: argparse.Namespace, options: InputOptions, output: str | None
) -> int:
    from minislam.data import RunFolder, open_sequence
    from minislam.runs.run import choose_priors, run_sequence

    if args.resume and output is None:
        raise InputError(
            "expected --output FOLDER with --resume, found none; give that of the interrupted run"
        )
    config = resumed_settings(args, output) if args.resume else settings(args)
    progress = ProgressLine()

    def report(stage: str, done: int, of_all: int) -> None:
        progress.show(stage, done, of_all)
        stop.check()

    sequence = open_sequence(
        args.sequence, options, lambda done, of_all: report("making frames", done, of_all)
    )
    synthetic = args.sequence.startswith("synth:")
    choice = prior_choice(args, default_depth="simulated" if synthetic else "none")
    output = output or f"output/{sequence.name}_{time.strftime('%Y%m%d-%H%M%S')}"
    print(sequence.description)
    for warning in sequence.warnings:
        print(f"WARNING: {warning}", file=sys.stderr)
    # First what may be wrong: it must not cost an earlier run its files.
    priors, lpips = choose_priors(choice, sequence, config), lpips_of(args, sequence.camera)
    folder = RunFolder(output) if args.resume else RunFolder.create(output, args.overwrite)
    outcome = run_sequence(sequence, config, choice, priors, folder, report, lpips, args.resume)
    print(f"{outcome.state}:")
    for name, value in outcome.metrics.items():
        print(f"  {name:22s} {'unknown' if value is None else f'{value:.3f}'}")
    for warning in outcome.warnings:
        if warning not in sequence.warnings:
            print(f"WARNING: {warning}", file=sys.stderr)
    print(f"results in {folder.path}; open {folder.path}/report.html")
    if outcome.state == "interrupted":
        print(f"to go on, repeat the command with -o {folder.path} --resume")
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main())
