"""The command line, `minislam COMMAND`; `main` first."""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import minislam
from minislam.cli.bench import add_bench_parser
from minislam.cli.doctor import add_doctor_parser
from minislam.cli.evaluate import add_eval_parser
from minislam.cli.export import add_export_parser
from minislam.cli.help import (
    RUN_EPILOG,
    SHORT_EPILOG,
    UsageError,
    add_help,
    nearest,
    unknown_option,
)
from minislam.cli.log import Log, recorded
from minislam.cli.notebooks import add_notebooks_parser
from minislam.cli.options import (
    add_input,
    add_lpips,
    add_priors,
    add_settings,
    add_talk,
    changed_settings,
    input_options,
    lpips_of,
    prior_choice,
    resumed_settings,
    settings,
    source_of,
    take_settings,
)
from minislam.cli.priors import add_priors_parser
from minislam.cli.progress import ProgressLine, ending_signals, plan_of, say
from minislam.cli.render import add_render_parser
from minislam.cli.settings import add_settings_parser
from minislam.cli.weights import add_weights_parser
from minislam.data.files import require_free
from minislam.data.options import default_depth, require_source
from minislam.errors import InputError, MinislamError
from minislam.priors.names import require_priors

DEMO_SEQUENCE, DEMO_FRAMES = "synth:crowd", 60
FAILED_EXIT, USAGE_EXIT, INTERRUPTED_EXIT = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    # OpenCV and FFmpeg would print messages about a damaged file beside our own error message.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    warnings.formatwarning = lambda message, *_, **__: f"WARNING: {message}\n"
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w"))
        if hasattr(getattr(sys, name), "reconfigure"):  # so that every file name can be printed
            getattr(sys, name).reconfigure(errors="backslashreplace")
    try:
        with ending_signals(signal.default_int_handler):
            exit_code = _command(sys.argv[1:] if arguments is None else list(arguments))
            sys.stdout.flush()
        return exit_code
    except KeyboardInterrupt:
        say("minislam: interrupted", "stderr")
        return INTERRUPTED_EXIT
    except BrokenPipeError:  # `minislam weights list | head`: the reader has seen enough
        return FAILED_EXIT
    except Exception as error:
        if os.environ.get("MINISLAM_DEBUG"):
            raise
        text = str(error)
        if not isinstance(error, MinislamError):
            text = (
                f"expected to finish this command, found {type(error).__name__}: "
                f"{' '.join(text.split())[:300]}; check names, permissions, space and "
                "settings, and set MINISLAM_DEBUG=1 to see where it happened"
            )
        say(f"minislam: {text}", "stderr")
        return USAGE_EXIT if isinstance(error, UsageError) else FAILED_EXIT
    finally:
        say("", end="")  # what is still in the buffer, or else nothing


def _command(arguments: list[str]) -> int:
    parser = _parser()
    commands = parser.get_default("commands")
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "-h"]
    if not arguments:
        parser.print_help()
        return USAGE_EXIT
    if not arguments[0].startswith("-") and arguments[0] not in commands:
        near = nearest(arguments[0], commands)
        raise UsageError(
            f"expected a command, found {arguments[0]!r}; "
            + (f"the nearest is {near}" if near else f"choose one of {', '.join(commands)}")
        )
    given: dict[str, str] = {}
    if arguments[0] in commands and commands[arguments[0]].get_default("takes_settings"):
        arguments, given = take_settings(arguments)
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        raise unknown_option(unknown[0], args.parser)
    args.settings = given
    return args.run(args)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="minislam",
        description="Monocular Gaussian-splatting SLAM for scenes with moving objects.",
        epilog="minislam COMMAND -h shows what a command takes; minislam demo is a start.",
    )
    parser.add_argument("--version", action="version", version=f"minislam {minislam.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_run(commands)
    for add in (
        add_settings_parser,
        add_priors_parser,
        add_weights_parser,
        add_bench_parser,
        add_notebooks_parser,
        add_eval_parser,
        add_render_parser,
        add_export_parser,
        add_doctor_parser,
    ):
        add(commands)
    for command in commands.choices.values():
        command.set_defaults(parser=command)
    parser.set_defaults(commands=commands.choices)
    return parser


def _add_demo(commands: argparse._SubParsersAction) -> None:
    demo = commands.add_parser(
        "demo",
        help="make a synthetic clip with moving people and run everything on it",
        usage="minislam demo [-o OUTPUT] [options]",
        add_help=False,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=SHORT_EPILOG,
    )
    add_help(demo)
    demo.add_argument(
        "-o", "--output", metavar="DIR", default="output/demo", help="run folder, output/demo"
    )
    add_talk(demo)
    add_settings(demo)
    demo.set_defaults(
        run=_run, sequence=DEMO_SEQUENCE, max_frames=DEMO_FRAMES, overwrite=True, resume=False
    )


def _add_run(commands: argparse._SubParsersAction) -> None:
    run = commands.add_parser(
        "run",
        help="run SLAM on a video, an image folder or a benchmark",
        usage="minislam run SEQUENCE [-o OUTPUT] [options]",
        add_help=False,
        allow_abbrev=False,  # half a setting's name might be another setting tomorrow
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=RUN_EPILOG,
    )
    add_help(run)
    run.add_argument("-o", "--output", metavar="DIR", help="run folder, default output/NAME_TIME")
    earlier = run.add_mutually_exclusive_group()
    earlier.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    earlier.add_argument(
        "--resume", action="store_true", help="go on with the interrupted run in OUTPUT"
    )
    add_talk(run)
    add_settings(run)
    add_input(run)
    add_priors(run, default_depth="simulated for synth:, else none", with_flow=True)
    add_lpips(run)
    run.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    with recorded(args.quiet) as log:
        return _run_recorded(args, log)


def _run_recorded(args: argparse.Namespace, log: Log) -> int:
    if args.resume and args.output is None:
        raise InputError(
            "expected --output FOLDER with --resume, found none; give that of the interrupted run"
        )
    # What may be wrong is looked for in the order of the time that it takes.
    source, inputs = source_of(args), input_options(args)
    require_source(source)
    if args.output and not args.resume:
        also = " (or --resume, to go on with an interrupted run)"
        require_free(args.output, args.overwrite, also)
    choice = prior_choice(args, default_depth(source))
    require_priors(choice)
    from minislam.data import open_sequence
    from minislam.runs.run import default_output, run_in_folder
    from minislam.runs.summary import as_text

    config = resumed_settings(args) if args.resume else settings(args)
    lpips, progress = lpips_of(args), ProgressLine(args.quiet, args.verbose)
    sequence = open_sequence(source, inputs, partial(progress.show, "making frames"))
    if lpips is not None:
        lpips.require_size(sequence.camera.width, sequence.camera.height)
    output = args.output or default_output(sequence)
    say(sequence.description)
    if args.verbose:
        for name, value in changed_settings(config).items():
            say(f"  {name} {value}")
    for warning in sequence.warnings:
        say(f"WARNING: {warning}", "stderr")
    progress.plan = plan_of(config, choice, sequence)
    log.write_to(Path(output))
    with ending_signals(progress.interrupt):
        outcome = run_in_folder(
            sequence, config, choice, output, progress, lpips, args.overwrite, args.resume
        )
    say("\n".join([f"{outcome.state}:", *as_text(outcome.summary)]))
    for warning in outcome.warnings:
        if warning not in sequence.warnings:
            say(f"WARNING: {warning}", "stderr")
    say(f"results in {output}; open {(Path(output).resolve() / 'report.html').as_uri()}")
    if outcome.state == "interrupted":
        say(f"to go on: minislam run --resume -o {shlex.quote(output)}")
    else:
        say(f"next: minislam render {shlex.quote(output)} -o fly.webm, or minislam export -h")
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main())
