"""The sub-commands `minislam demo` and `minislam run`."""

import argparse
from contextlib import closing
from functools import partial
from os.path import expanduser
from pathlib import Path

from minislam.cli import options
from minislam.cli.help import RUN_EPILOG, SHORT_EPILOG, add_command
from minislam.cli.log import recorded
from minislam.data.files import require_free
from minislam.data.options import default_depth, require_source
from minislam.data.run_folder import CHECKPOINT, REPORT
from minislam.errors import InputError, require
from minislam.parameters import require_bounds
from minislam.runs.progress import ProgressLine, ending_signals, quoted, say

DEMO = {"sequence": "synth:crowd", "max_frames": 60, "output": "output/demo"}


def add_parser(commands: argparse._SubParsersAction) -> None:
    what = "make a synthetic clip with moving people and run everything on it"
    demo = add_command(commands, "demo", what, "[-o OUTPUT]", SHORT_EPILOG)
    where = partial(demo.add_argument, "-o", "--output", type=expanduser, metavar="DIR")
    where(help="run folder, output/demo")
    demo.add_argument("--overwrite", action="store_true", help="replace an earlier run there")
    options.add_talk(demo)
    options.add_settings(demo)
    demo.set_defaults(run=_demo, resume=False, otherwise="", **DEMO)

    what = "run SLAM on a video, an image folder or a benchmark"
    run = add_command(commands, "run", what, "SEQUENCE [-o OUTPUT]", RUN_EPILOG)
    where = partial(run.add_argument, "-o", "--output", type=expanduser, metavar="DIR")
    where(help="run folder, default output/NAME_TIME")
    earlier = run.add_mutually_exclusive_group()
    earlier.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    earlier.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    options.add_talk(run)
    options.add_settings(run)
    options.add_input(run)
    options.add_priors(run, depth="simulated for synth:, else none", with_flow=True)
    lpips = run.add_argument_group("LPIPS", "measured if both files are given")
    lpips.add_argument("--lpips-trunk", metavar="FILE", help="torchvision's AlexNet or VGG-16")
    lpips.add_argument("--lpips-heads", metavar="FILE", help="the authors' alex.pth or vgg.pth")
    run.set_defaults(run=_run, otherwise=" (or --resume, to go on with an interrupted run)")


def _demo(args: argparse.Namespace) -> int:
    args.overwrite |= args.output == DEMO["output"]  # what is there was a demo, too
    return _run(args)


def _run(args: argparse.Namespace) -> int:
    require_bounds("--workers", args.workers, 1, 256)
    found = "none; give that of the interrupted run"
    require(args.output is not None or not args.resume, "--output FOLDER with --resume", found)
    with recorded(args.quiet) as log:
        # What may be wrong is looked for in the order of the time that it takes.
        source, inputs = options.source_of(args), options.input_options(args)
        try:
            require_source(source)
        except InputError as error:
            where = f", move it back, or correct sequence, which {args.output}/config.json names"
            raise InputError(f"{error}{where if args.resume else ''}") from error
        if args.output and not args.resume:
            require_free(args.output, args.overwrite, args.otherwise)
        choice = options.prior_choice(args, default_depth(source))
        from minislam.data.sequence import open_sequence
        from minislam.runs.resume import NO_WAY_ON, way_on
        from minislam.runs.run import default_output, plan_of, run_in_folder
        from minislam.runs.summary import as_text, summarise

        if args.resume and not way_on(args.output):
            found = f"expected an interrupted run in {args.output}, found no {CHECKPOINT}"
            raise InputError(f"{found}, as in a finished run; see report.html, or start a new run")
        config, lpips = options.settings(args), options.lpips_of(args)
        progress = ProgressLine(args.quiet, args.verbose)
        sequence = open_sequence(source, inputs, partial(progress.show, "making frames"))
        if lpips is not None:
            lpips.require_size(sequence.camera.width, sequence.camera.height)
        output = args.output or default_output(sequence)
        say(sequence.description)
        for warning in sequence.warnings:
            say(f"WARNING: {warning}", "stderr")
        progress.plan = plan_of(config, choice, sequence)
        log.write_into(Path(output))
        mode = args.overwrite, args.resume, args.workers
        with closing(progress), ending_signals(progress.interrupt):
            metrics, facts = run_in_folder(sequence, config, choice, output, progress, lpips, *mode)
        say("\n".join([f"{facts['state']}:", *as_text(summarise(metrics, facts))]))
        for warning in facts["warnings"]:
            if warning not in sequence.warnings and not (args.quiet and warning in progress.warned):
                say(f"WARNING: {warning}", "stderr")
        say(f"results in {output}; open {(Path(output).resolve() / REPORT).as_uri()}")
        if facts["state"] == "interrupted":
            say(way_on(output) or NO_WAY_ON)
        else:
            say(f"next: minislam render {quoted(output)} -o fly.webm, or minislam export -h")
        return facts["exit_code"]
