"""The command line, `minislam COMMAND`; `main` first."""

import argparse
import ctypes
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module

import minislam
from minislam.cli.help import UsageError, unknown_option
from minislam.cli.options import take_settings
from minislam.errors import FAILED_EXIT, INTERRUPTED_EXIT, USAGE_EXIT, MinislamError, nearest
from minislam.runs.progress import ProgressLine, ending_signals, say

# The modules of minislam.cli that add the commands, in the order of the help.
COMMANDS = "run render export evaluate settings weights priors bench notebooks grade doctor".split()
# Settings MALLOC_* of glibc: their numbers for mallopt, and values. One arena for all threads, and
# blocks of 4 MB and more mapped one by one, because freed images leave holes that later ones do
# not fit. 64 MB that are free stay in the process: to return them took a tenth of a run's time.
MALLOC = {"ARENA_MAX": (-8, 1), "MMAP_THRESHOLD_": (-3, 4 << 20), "TRIM_THRESHOLD_": (-1, 64 << 20)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    set_malloc()
    # Descriptors 0 to 2 that the caller has closed: a pipe must not get the number of a stream.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    # OpenCV and FFmpeg would print messages about a damaged file beside our own error message.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    warnings.formatwarning = lambda message, *_, **__: f"WARNING: {message}\n"
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # None: closed by the caller
        if hasattr(stream, "reconfigure"):  # so that every file name can be printed
            stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, stream)
    try:
        with ending_signals(signal.default_int_handler):
            exit_code = _command(sys.argv[1:] if arguments is None else list(arguments))
            sys.stdout.flush()
        return exit_code
    except KeyboardInterrupt as error:
        ProgressLine().tell(f"minislam: {str(error) or 'interrupted'}")
        return INTERRUPTED_EXIT
    except BrokenPipeError:  # `minislam weights list | head`: the reader has seen enough
        return FAILED_EXIT
    except Exception as error:
        if os.environ.get("MINISLAM_DEBUG"):
            raise
        text = str(error)
        if isinstance(error, ModuleNotFoundError) and error.name:
            advice = "activate the environment of minislam, or pip install -r environment.txt"
            text = f"expected {error.name} in this Python, {sys.executable}, found none; {advice}"
        elif not isinstance(error, MinislamError):
            found = f"{type(error).__name__}: {' '.join(text.split())[:300]}"
            advice = "check names, permissions, space and settings, and set MINISLAM_DEBUG=1"
            text = f"expected to finish this command, found {found}; {advice} to see where it was"
        ProgressLine().tell(f"minislam: {text}")
        return USAGE_EXIT if isinstance(error, UsageError) else FAILED_EXIT
    finally:
        say("", end="")  # what is still in the buffer, or else nothing


def set_malloc() -> None:
    """Apply MALLOC here and in the processes that this one starts; a variable that is set stays."""
    for name, (parameter, value) in MALLOC.items():
        if f"MALLOC_{name}" not in os.environ:
            os.environ[f"MALLOC_{name}"] = str(value)
            with suppress(OSError, TypeError, AttributeError):  # another C library has none of them
                ctypes.CDLL(None).mallopt(parameter, value)


def _command(arguments: list[str]) -> int:
    if not arguments:
        _parser().print_help()
        return USAGE_EXIT
    args = parsed(arguments)
    return args.run(args) or 0  # a command without an exit code of its own has succeeded


def parsed(arguments: list[str]) -> argparse.Namespace:
    """Return the arguments of a command; raises `UsageError` for one that it does not have."""
    parser = _parser()
    commands = parser.get_default("commands")
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "-h"]
    words = [word for word in arguments if not word.startswith("-")]
    if words[:2] == ["eval", "tum"]:  # evo asks for the format
        arguments = [*arguments]
        arguments.remove("tum")  # the first: a run folder may be called so
    if not arguments[0].startswith("-") and arguments[0] not in commands:
        hint = nearest(arguments[0], commands, f"choose one of {', '.join(commands)}")
        raise UsageError(f"expected a command, found {arguments[0]!r}; {hint}")
    given: dict[str, str] = {}
    if arguments[0] in commands and commands[arguments[0]].get_default("takes_settings"):
        arguments, given = take_settings(arguments)
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        raise unknown_option(unknown[0], args.parser)
    args.settings = given
    return args


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="minislam",
        description="Monocular Gaussian-splatting SLAM for scenes with moving objects.",
        epilog="minislam COMMAND -h shows what a command takes; minislam demo is a start.",
    )
    parser.add_argument("--version", action="version", version=f"minislam {minislam.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name in COMMANDS:
        import_module(f"minislam.cli.{name}").add_parser(commands)
    for command in commands.choices.values():
        command.set_defaults(parser=command, of_run=commands.choices["run"]._option_string_actions)
    parser.set_defaults(commands=commands.choices)
    return parser
