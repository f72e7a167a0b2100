"""The sub-command `minislam settings`: every setting, with its default, bounds and meaning."""

import argparse
import fnmatch
import shutil
import textwrap

from minislam.errors import nearest, require


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "settings",
        help="list the constants, each of which is an option of run",
        description="Every constant with its default, its bounds, its meaning and [its unit]. "
        "Change one with minislam run ... --NAME VALUE, or in a file for --config.",
    )
    what = "part of a name, or a pattern like tracking.*round*"
    parser.add_argument("pattern", nargs="?", default="", help=what)
    parser.set_defaults(run=_settings)


def _settings(args: argparse.Namespace) -> None:
    from minislam.config import PRESETS, SlamConfig
    from minislam.parameters import MOST, leaves

    settings = {name: (value, entry.metadata) for name, value, entry in leaves(SlamConfig())}
    found = fnmatch.filter(settings, f"*{args.pattern}*")
    hint = nearest(args.pattern, settings, "minislam settings lists all of them")
    require(bool(found), "part of a setting's name", f"{args.pattern!r} in none; {hint}")
    width = min(max(shutil.get_terminal_size().columns, 20), 100)
    for name in found:
        value, about = settings[name]
        least, most = about["least"], about["most"]
        bounds = f"at least {least:g}" if most == MOST else f"{least:g} to {most:g}"
        notes = ["on or off" if isinstance(value, bool) else bounds]
        notes += [f"{key} {_shown(PRESETS[key][name])}" for key in PRESETS if name in PRESETS[key]]
        print(f"--{name} {_shown(value)}  ({'; '.join(notes)})")
        print(textwrap.indent(textwrap.fill(about["meaning"], width - 4), "    "))


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
