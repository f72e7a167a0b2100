"""What `-h` and `--help` show, and the hint after an option that does not exist."""

import argparse
import difflib
import textwrap
from typing import Any

from minislam.errors import InputError

# What most people need; `--help` shows the rest, too.
ESSENTIAL = (
    "--help --output --overwrite --resume --quiet --verbose --preset --config --no-uncertainty "
    "--stride --max-frames --size --fx --calibration --features --depth --flow --out"
).split()
SHORT_EPILOG = """\
every option, files of a run folder, exit codes:  minislam run --help
constants, each of them an option:                minislam settings [PATTERN]
"""
RUN_EPILOG = """\
files of a run folder:
  report.html, viewer.html, clip.webp      open report.html first
  plots/, keyframes/                       its pictures
  map.ply                                  Gaussians for any 3DGS viewer; y points down
  trajectory.txt, keyframe_trajectory.txt  poses in TUM format, timestamps of the source
  lost_frames.txt                          frames without a pose, and why
  uncertainty_mlp.pt                       weights of the uncertainty MLP
  metrics.json                             accuracy, null where unknown
  run.json, log.txt                        timings, warnings, how the run ended; what was printed
  config.json, camera.json                 sequence, input, priors and settings; camera and frames
  checkpoint.npz                           until the run is finished: arrays, no pickle
Frame numbers in files and messages count the frames of the run from 0.

minislam run --config FOLDER/config.json -o NEW_FOLDER
  repeats a run, on the same CPU to the same bytes. Other flags replace values of the file.

minislam run --resume -o FOLDER
  continues after Ctrl-C, a power cut, a full disk or a damaged image from the last checkpoint
  to the same bytes. Other settings are refused. Checkpoints are written before each of the
  last stages, on Ctrl-C, and between steps in --checkpoint_fraction of the time (1 %).

exit codes: 0 finished; 1 what was given cannot be used, in one sentence; 2 wrong usage: an unknown
  command or option, a missing value, or no number where an option that is no setting needs one;
  3 finished but not to be trusted as a whole: frames were lost or left out, the trajectory is
  broken (motion and depth contradict the images; run.json lists the breaks and the segments between
  them, and the map shows the longest), the map has large holes or most bundle adjustments failed;
  130 interrupted with everything so far written

settings: each is an option, like --tracking.window 8; minislam settings lists them.
  Ablations of the paper:
  --no-uncertainty                       the same weight for every pixel
  --uncertainty.lambda_depth 0           no depth term in L_uncer, Eq. (4)
  --uncertainty.given_masks on           the sequence's own masks instead of the learned beta
  --tracking.lambda_disparity_prior .01  disparity prior in Eq. (5), else with learned flow only
  --tracking.prior_mask off              no mask M, where there is a disparity prior
  --tracking.final_prior on              disparity prior also in the final adjustment
  --mapping.pose_refinement.enabled on   poses between keyframes refined by re-rendering
  --mapping.keyframe_stride 5            map optimised every 5 keyframes (fast mode)
"""


class UsageError(InputError):
    """A command or an option that does not exist: exit code 2."""


class Help(argparse.Action):
    """`-h` shows what most people need, `--help` everything."""

    def __call__(self, parser: argparse.ArgumentParser, *rest: Any) -> None:
        """Print the help and end the program."""
        if rest[-1] == "-h":  # what was typed
            parser.epilog = SHORT_EPILOG
            for action in parser._actions:
                if action.option_strings and not set(action.option_strings) & set(ESSENTIAL):
                    action.help = argparse.SUPPRESS
            for group in parser._action_groups:
                group.description = None
        elif parser.epilog is RUN_EPILOG:
            from data_synth import SEQUENCES  # only here: it needs numpy

            clips = ", ".join(SEQUENCES)
            text = f"synthetic clips, synth:NAME[:SEED][?phone, as one films it]: {clips}"
            parser.epilog = f"{textwrap.fill(text, 96, subsequent_indent='  ')}\n\n{RUN_EPILOG}"
        parser.print_help()
        parser.exit()


def add_command(
    commands: argparse._SubParsersAction, name: str, what: str, usage: str, epilog: str | None
) -> argparse.ArgumentParser:
    """Add a command with many options, hence with a short help as -h and a long one as --help."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=what,
        usage=f"minislam {name} {usage} [options]",
        add_help=False,
        allow_abbrev=False,  # half a setting's name might be another setting tomorrow
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=epilog,
    )
    shown = "the most needed options, or all of them"
    parser.add_argument("-h", "--help", action=Help, nargs=0, help=shown)
    return parser


def unknown_option(found: str, parser: argparse.ArgumentParser) -> UsageError:
    """Return what to say about an option that a command lacks: whose it is, or the nearest."""
    if not found.startswith("-"):
        wanted = f"only the names that {parser.prog} takes"
        return UsageError(f"expected {wanted}, found also {found!r}; quote a name with spaces")
    name = found.partition("=")[0]
    is_of_run = name in (parser.get_default("of_run") or ())
    otherwise = "it is an option of minislam run" if is_of_run else f"see {parser.prog} --help"
    known, typed = {o.strip("-"): o for o in parser._option_string_actions}, name.strip("-")
    near = difflib.get_close_matches(typed, known, n=1, cutoff=0.65 if is_of_run else 0.6)
    if parser.get_default("takes_settings") and not near and not is_of_run:
        from minislam.config import SlamConfig, settings_of

        # A name without dots may be the end of a setting's; the first setting with it comes last.
        settings = reversed(settings_of(SlamConfig()))
        known = {s if "." in name else s.rpartition(".")[2]: f"--{s}" for s in settings}
        near = difflib.get_close_matches(typed, known, n=1, cutoff=0.7)
    hint = f"the nearest is {known[near[0]]}" if near else parser.get_default("hint") or otherwise
    return UsageError(f"expected a known option, found {name}; {hint}")
