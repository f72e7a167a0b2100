"""The sub-command `minislam notebooks`: copies of the course, for students without solutions."""

from __future__ import annotations

import argparse
import copy
import json
import re
from pathlib import Path

import minislam
from minislam.errors import InputError

SOLUTION = re.compile(r"^([ \t]*)### BEGIN SOLUTION\n.*?^[ \t]*### END SOLUTION$", re.S | re.M)


def add_notebooks_parser(subparsers: argparse._SubParsersAction) -> None:
    """Add `notebooks` to the sub-commands of a parser."""
    parser = subparsers.add_parser("notebooks", help="copy the course's notebooks into a folder")
    parser.add_argument("folder", metavar="DIR", help="where to; made if it does not exist")
    parser.add_argument("--student", action="store_true", help="without the exercises' solutions")
    parser.set_defaults(run=run_notebooks)


def run_notebooks(args: argparse.Namespace) -> int:
    """Copy all notebooks, never over a file that is there; return the exit code."""
    from minislam.data.files import read_text, write_text  # needs torch

    # A wheel holds the notebooks inside the package, the repository beside it.
    folder, package = Path(args.folder).expanduser(), Path(minislam.__file__).parent
    paths = sorted(package.glob("notebooks/*.ipynb")) or sorted(
        package.glob("../notebooks/*.ipynb")
    )
    if not paths:
        raise InputError(f"expected notebooks in {package} or beside it, found none; install again")
    there = [path.name for path in paths if (folder / path.name).exists()]
    if there:
        raise InputError(
            f"expected a folder without these notebooks, found {there[0]} in {folder}; give "
            "another one, so that nobody's work is lost"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        text = read_text(path)
        if args.student:
            text = as_text(without_solutions(json.loads(text)))
        write_text(folder / path.name, text)
    print(f"{len(paths)} notebooks in {folder}; open them with: jupyter lab {folder}")
    return 0


def without_solutions(notebook: dict) -> dict:
    """Return the copy for students: each solution becomes `raise NotImplementedError`."""
    result = copy.deepcopy(notebook)
    for cell in result["cells"]:
        if cell["cell_type"] == "code":
            text = "".join(cell["source"])
            text = SOLUTION.sub(r"\1raise NotImplementedError  # your code here", text)
            cell["source"] = text.splitlines(keepends=True)
            cell["outputs"], cell["execution_count"] = [], None
    return result


def as_text(notebook: dict) -> str:
    """Return a notebook as it is stored: the same content, the same bytes."""
    return json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
