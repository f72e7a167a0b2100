"""The sub-command `minislam bench`: run benchmarks, and set their errors beside the paper's.

Each sequence is a `minislam run` in its own process: memory and crash of one stay with it.
"""

import argparse
import csv
import io
import os
import subprocess
import sys
from pathlib import Path

from minislam.cli.help import UsageError
from minislam.cli.options import input_options, lpips_of, prior_choice, settings
from minislam.data.files import make_folder, read_json, write_json, write_text
from minislam.data.run_folder import CHECKPOINT, METRICS, RUN
from minislam.errors import INTERRUPTED_EXIT, LOST_EXIT, InputError, require
from minislam.parameters import user_path
from minislam.runs.progress import ending_signals, quoted, say

USAGE = "minislam bench FOLDER... [-o OUT] [options of minislam run]"
LEGEND = """\
RMSE of the ATE over all frames, for minislam after a Sim(3) alignment. F: failed. -: no number.
*: exit code 3, not to be trusted as a whole (minislam); run by the paper's authors (others)."""


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "bench",
        help="run the sequences of benchmarks, and compare with the published errors",
        usage=USAGE,
        description="Run every sequence (TUM, Bonn, Wild-SLAM MoCap) in the folders, and print its "
        "ATE below the published ones. The same command again goes on: a finished sequence is not "
        "repeated, an interrupted one is resumed. OUT (output/bench) gets a run folder for each "
        "sequence, bench.csv and bench.md.",
    )
    parser.add_argument(
        "folders", nargs="+", metavar="FOLDER", help="sequences, or what holds them"
    )
    parser.add_argument("options", nargs=argparse.REMAINDER, help="-o OUT, options of minislam run")
    parser.set_defaults(run=_bench, hint="folders come first, then the options")


def _bench(args: argparse.Namespace) -> int:
    """Run what is not finished, print and write the tables; return the exit code."""
    from minislam.cli.main import parsed  # which imports this module

    own = argparse.ArgumentParser(prog="minislam bench", usage=USAGE, allow_abbrev=False)
    own.add_argument("-o", "--output", default="output/bench", type=user_path)
    given, options = own.parse_known_args(args.options)
    for flag in ("--overwrite", "--resume"):
        if flag in options:
            advice = "leave it out, bench resumes by itself, and begins anew with another -o"
            raise UsageError(f"expected no {flag}, found it; {advice}")
    sequences, noted = find_sequences(args.folders), given.output / "options.json"
    run = parsed(["run", args.folders[0], "--overwrite", *options])
    settings(run), input_options(run), prior_choice(run, "none"), lpips_of(run)  # or refuse them
    make_folder(given.output)
    if noted.exists() and (then := read_json(noted)) != options:
        wanted = f"the options of the bench in {given.output}, {then}"
        raise InputError(f"expected {wanted}, found {options}; repeat those, or give another -o")
    write_json(noted, options)
    ours: dict[str, str] = {}
    tables, code = "", 0
    for number, (name, path) in enumerate(sequences.items(), start=1):
        say(f"== {number} of {len(sequences)}: {name}")
        code, ate_cm = _run(path, given.output / name, options)
        if code == INTERRUPTED_EXIT:
            break
        ours[name] = ate_cm
        tables = _write_tables(given.output, ours, options)
    if tables:
        say(f"\n{tables}\nin {given.output}/bench.md and {given.output}/bench.csv")
    return code if len(ours) < len(sequences) else int("F" in ours.values())


def find_sequences(folders: list[str]) -> dict[str, Path]:
    """Return the sequences that folders are, or hold one or two levels below, by their names."""
    from minislam.data.tum import is_tum_folder
    from minislam.evaluation.published import plain_name

    found: dict[str, Path] = {}
    for folder in map(Path, folders):
        inside = [folder, *sorted(folder.glob("*")), *sorted(folder.glob("*/*"))]
        paths = [path for path in inside if path.is_dir() and is_tum_folder(path)]
        wanted = f"sequences (folders with rgb.txt, or rgb/ with times as names) in {folder}"
        require(bool(paths), wanted, "none; check the path")
        for path in paths:
            name = path.resolve().name
            if (path / "synth.json").exists():  # it may be called as one of theirs, and is not
                name = f"synthetic-{name}"
            two = f"two called {name}; bench them in two commands, each with its own -o"
            is_new = plain_name(name) not in map(plain_name, found)  # in the tables, too
            require(is_new, "sequences of different names", two)
            found[name] = path
    return found


def _run(path: Path, folder: Path, options: list[str]) -> tuple[int, str]:
    """Run a sequence, or resume it, if it is not finished; return exit code and ATE."""
    facts = folder / RUN
    if facts.exists() and str(read_json(facts).get("state")).startswith("finished"):
        code = read_json(facts)["exit_code"]
    else:
        start = "--resume" if (folder / CHECKPOINT).exists() else "--overwrite"
        code = _wait_for(["run", str(path), "-o", str(folder), start, *options])
    if code not in (0, LOST_EXIT):
        return code, "F"
    ate_cm = read_json(folder / METRICS)["ate_all_cm"]
    return code, "-" if ate_cm is None else f"{ate_cm:.2f}{'*' if code else ''}"


def _wait_for(arguments: list[str]) -> int:
    """Run minislam in a process of its own; a signal reaches it through us alone, and ends it."""
    command = [sys.executable, "-m", "minislam", *arguments]
    process = subprocess.Popen(command, start_new_session=True)
    caught: list[int] = []

    def forward(number: int, *_: object) -> None:
        caught.append(number)
        if os.name == "posix":  # on Windows a console tells both
            process.send_signal(number)

    with ending_signals(forward):
        code = process.wait()
    return INTERRUPTED_EXIT if caught else code


def _write_tables(output: Path, ours: dict[str, str], options: list[str]) -> str:
    """Write bench.csv and bench.md; return the latter."""
    from minislam.evaluation.published import compare

    text, file = "", io.StringIO()
    for dataset, rows in compare(ours).items():
        csv.writer(file, lineterminator="\n").writerows([[dataset], *rows])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        rows.insert(1, ["-" * width for width in widths])
        lines = [f"| {' | '.join(map(str.ljust, row, widths))} |" for row in rows]
        text += "\n".join([f"{dataset}:\n", *lines, "\n"])
    write_text(output / "bench.csv", file.getvalue())
    text += LEGEND + (f"\nOptions: {' '.join(map(quoted, options))}" if options else "")
    write_text(output / "bench.md", text + "\n")
    return text
