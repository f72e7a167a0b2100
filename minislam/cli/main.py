"""The command line, `minislam demo | run | render | bench | ...`; `main` first."""

from __future__ import annotations

import argparse
import difflib
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from functools import partial

import minislam
from minislam.cli.bench import add_bench_parser
from minislam.cli.doctor import add_doctor_parser
from minislam.cli.evaluate import add_eval_parser
from minislam.cli.notebooks import add_notebooks_parser
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
    source_of,
)
from minislam.cli.priors import add_priors_parser
from minislam.cli.progress import ProgressLine, ending_signals, say
from minislam.cli.render import add_render_parser
from minislam.cli.weights import add_weights_parser
from minislam.errors import InputError, MinislamError

DEMO_SEQUENCE, DEMO_FRAMES = "synth:crowd", 60
FAILED_EXIT, USAGE_EXIT, INTERRUPTED_EXIT = 1, 2, 130
RUN_EPILOG = """\
files of a run folder:
  trajectory.txt, keyframe_trajectory.txt  poses in TUM format, timestamps of the source
  lost_frames.txt                          frames without a pose, and why
  map.ply                                  Gaussians for any 3DGS viewer; y points down
  uncertainty_mlp.pt                       weights of the uncertainty MLP
  metrics.json                             accuracy, null where unknown
  run.json                                 timings, warnings, how the run ended
  config.json                              sequence, input, priors and settings
  report.html, plots/, keyframes/          pictures; report.html shows most of them
  checkpoint.npz                           until the run is finished: arrays, no pickle

minislam run --config FOLDER/config.json -o NEW_FOLDER
  repeats a run, on the same CPU to the same bytes. Other flags replace values of the file.

minislam run --resume -o FOLDER
  continues after Ctrl-C, a power cut, a full disk or a damaged image from the last checkpoint
  to the same bytes. Other settings are refused. Checkpoints are written before each of the
  last stages, on Ctrl-C, and between steps in --checkpoint_fraction of the time (1 %).

exit codes: 0 finished, 1 known error in one sentence, 2 wrong usage, 3 finished but not to be
  trusted as a whole: frames were lost, the trajectory is broken (motion and depth contradict the
  images; run.json lists the breaks and the segments between them) or most bundle adjustments
  failed, 130 interrupted with everything so far written

ablations of the paper:
  --no-uncertainty                       the same weight for every pixel
  --uncertainty.lambda_depth 0           no depth term in L_uncer, Eq. (4)
  --uncertainty.given_masks on           the sequence's own masks instead of the learnt beta
  --tracking.lambda_disparity_prior 0    no disparity prior in Eq. (5)
  --tracking.prior_mask off              no mask M
  --tracking.final_prior on              disparity prior also in the final adjustment
  --mapping.pose_refinement.enabled off  no photometric refinement of the other frames
  --mapping.keyframe_stride 5            map optimised every 5 keyframes (fast mode)
"""


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
        return FAILED_EXIT
    finally:
        say("", end="")  # what is still in the buffer, or else nothing


def _command(arguments: list[str]) -> int:
    args, unknown = _parser(arguments).parse_known_args(arguments)
    if unknown:
        say(f"minislam: {_unknown_option(unknown[0], args)}", "stderr")
        return USAGE_EXIT
    return args.run(args)


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
        run=_run, sequence=DEMO_SEQUENCE, max_frames=DEMO_FRAMES, overwrite=True, resume=False
    )

    run = commands.add_parser(
        "run",
        help="run SLAM on a video, an image folder or a benchmark",
        usage="minislam run SEQUENCE [-o OUTPUT] [options]",
        allow_abbrev=False,  # half a setting's name might be another setting tomorrow
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=RUN_EPILOG,
    )
    run.add_argument("-o", "--output", help="run folder, default output/NAME_TIME")
    earlier = run.add_mutually_exclusive_group()
    earlier.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    earlier.add_argument(
        "--resume", action="store_true", help="go on with the interrupted run in OUTPUT"
    )
    run.set_defaults(run=_run)
    priors = add_priors_parser(commands)
    # These options need torch, which takes seconds to import: only their own command waits for it.
    command = arguments[0] if arguments else ""
    if command == "demo":
        add_settings(demo)
    elif command == "run":
        add_input(run)
        add_priors(run, default_depth="simulated for synth:, else none")
        add_flow(run)
        add_lpips(run)
        add_settings(run)
    elif command == "priors":
        add_input(priors)
        add_priors(priors, default_depth="none")
        add_settings(priors)
    add_weights_parser(commands)
    add_bench_parser(commands)
    add_notebooks_parser(commands)
    add_eval_parser(commands)
    add_render_parser(commands)
    add_doctor_parser(commands)
    return parser


def _run(args: argparse.Namespace) -> int:
    from minislam.data import open_sequence
    from minislam.runs.run import default_depth, default_output, run_in_folder
    from minislam.runs.summary import as_text

    if args.resume and args.output is None:
        raise InputError(
            "expected --output FOLDER with --resume, found none; give that of the interrupted run"
        )
    config = resumed_settings(args) if args.resume else settings(args)
    source = source_of(args)
    progress = ProgressLine()
    sequence = open_sequence(source, input_options(args), partial(progress.show, "making frames"))
    choice = prior_choice(args, default_depth(source))
    output = args.output or default_output(sequence)
    say(sequence.description)
    for warning in sequence.warnings:
        say(f"WARNING: {warning}", "stderr")
    lpips = lpips_of(args, sequence.camera)
    with ending_signals(progress.interrupt):
        outcome = run_in_folder(
            sequence, config, choice, output, progress, lpips, args.overwrite, args.resume
        )
    say("\n".join([f"{outcome.state}:", *as_text(outcome.summary)]))
    for warning in outcome.warnings:
        if warning not in sequence.warnings:
            say(f"WARNING: {warning}", "stderr")
    say(f"results in {output}; open {output}/report.html")
    if outcome.state == "interrupted":
        say(f"to go on: minislam run --resume -o {output}")
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main())
