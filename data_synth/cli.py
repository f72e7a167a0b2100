"""The command line: write one sequence, or list them."""

import argparse
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

from .errors import SynthError
from .phone import Phone
from .scenes import SUMMARIES, default_frames
from .sequence import Progress
from .writing import write_sequence

EXIT_KNOWN_ERROR, EXIT_INTERRUPTED = 1, 130
BAR_WIDTH = 40  # characters


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # None: closed by the caller
        if hasattr(stream, "reconfigure"):  # so that every file name can be printed
            stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, stream)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # leave nothing half written
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.list:
        for name, summary in SUMMARIES.items():
            _say(f"{name:<12}{summary}")
        return 0
    if options.name is None or options.out is None:
        parser.error("name a sequence and a folder: python -m data_synth crowd --out data/crowd")
    try:
        size = parse_size(options.size)
        frames = default_frames(options.name) if options.frames is None else options.frames
        folder = write_sequence(
            options.name,
            options.seed,
            frames,
            size,
            options.out,
            progress_printer(),
            phone_of(options),
        )
    except SynthError as error:
        _say(f"error: {error}", "stderr")
        return EXIT_KNOWN_ERROR
    except OSError as error:
        cause = error.strerror or error
        _say(f"error: could not write {options.out}: {cause}", "stderr")
        return EXIT_KNOWN_ERROR
    except KeyboardInterrupt:
        _say("interrupted: nothing was written", "stderr")
        return EXIT_INTERRUPTED
    _say(f"{options.name}, seed {options.seed}, {frames} frames: {folder}")
    return 0


def _say(text: str, stream: str = "stdout", end: str = "\n") -> None:
    """Print; a reader that ends, or a full disk, ends only the printing."""
    try:
        print(text, end=end, file=getattr(sys, stream), flush=True)
    except OSError:
        setattr(sys, stream, open(os.devnull, "w"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m data_synth",
        description="Render a synthetic sequence with known truth into a TUM RGB-D folder.",
    )
    parser.add_argument("name", nargs="?", help="the sequence; --list shows them")
    parser.add_argument("--out", type=Path, help="the folder to write")
    parser.add_argument("--seed", type=int, default=0, help="another path, other textures")
    parser.add_argument("--frames", type=int, help="at 30 Hz (default 100; loop 400)")
    parser.add_argument("--size", default="320x240", help="width x height [px] (default 320x240)")
    parser.add_argument(
        "--phone",
        action="store_true",
        help="film as a phone: all that follows, and no calibration; upright with --size 240x320",
    )
    parser.add_argument("--readout", type=float, help="s from first to last line (phone: 0.02)")
    parser.add_argument("--shutter", type=float, help="s that a line is exposed (phone: 0.01)")
    parser.add_argument("--exposure", type=float, help="stops of its drift (phone: 0.25)")
    parser.add_argument("--white", type=float, help="drift of the white balance (phone: 0.08)")
    parser.add_argument("--list", action="store_true", help="list the sequences")
    return parser


def phone_of(options: argparse.Namespace) -> Phone | None:
    """Return the phone that is asked for: a whole one, or only the effects that are given."""
    names = ("readout", "shutter", "exposure", "white")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    if not options.phone and not given:
        return None
    none_of_it = Phone(0.0, 0.0, 0.0, 0.0, calibrated=True)
    return replace(Phone() if options.phone else none_of_it, **given)


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) from a text like 320x240."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise SynthError(f"--size is width x height in pixels, like 320x240, not {text!r}")
    return int(found[1]), int(found[2])


def progress_printer() -> Progress:
    """Return a bar on a terminal; elsewhere a plain line for every tenth of the way."""
    on_terminal = sys.stderr.isatty()

    def show(done: int, total: int) -> None:
        if on_terminal:
            bar = "#" * (BAR_WIDTH * done // total)
            end = "\n" if done == total else ""
            _say(f"\r[{bar:<{BAR_WIDTH}}] {done}/{total}", "stderr", end)
        elif 10 * done // total > 10 * (done - 1) // total:
            _say(f"{100 * done // total} % ({done} of {total} frames)", "stderr")

    return show
