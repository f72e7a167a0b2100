"""The sub-command `minislam notebooks`: copies of the course, with or without solutions."""

import argparse
import copy
import json
import re
from pathlib import Path

import minislam
from minislam.data.files import atomic_write, make_folder, read_bytes
from minislam.errors import InputError, require
from minislam.parameters import user_path
from minislam.runs.progress import quoted

SOLUTION = re.compile(r"^([ \t]*)### BEGIN SOLUTION\n.*?^[ \t]*### END SOLUTION$", re.S | re.M)


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("notebooks", help="copy the course's notebooks into a folder")
    parser.add_argument("folder", metavar="DIR", help="where to; made if it does not exist")
    parser.add_argument("--student", action="store_true", help="without solutions and outputs")
    parser.set_defaults(run=_notebooks)


def _notebooks(args: argparse.Namespace) -> None:
    """Copy all notebooks and what they name, never over a file."""
    # A wheel holds the notebooks inside the package, the repository beside it.
    folder, package = user_path(args.folder), Path(minislam.__file__).parent
    sources = [package / "notebooks", package.parent / "notebooks"]
    source = next((path for path in sources if any(path.glob("*.ipynb"))), None)
    if source is None:
        raise InputError(f"expected notebooks in {package} or beside it, found none; install again")
    copies = {path.name: read_bytes(path) for path in sorted(source.glob("*.ipynb"))}
    count, texts = len(copies), b"".join(copies.values())
    if args.student:
        for name, content in copies.items():
            copies[name] = as_text(without_solutions(json.loads(content))).encode()
    beside = {path.relative_to(source).as_posix(): path for path in sorted(source.glob("*/*.*"))}
    copies |= {name: read_bytes(path) for name, path in beside.items() if name.encode() in texts}
    for path in (source / "SYLLABUS.md", source / "LICENSE", source.parent / "LICENSE"):
        if path.is_file():
            copies[path.name] = read_bytes(path)
    make_folder(folder)
    there = next((name for name in copies if (folder / name).exists()), None)
    found = f"{there} in {folder}; give another"
    require(there is None, "a folder without these notebooks", found)
    for name, content in copies.items():
        make_folder((folder / name).parent)
        atomic_write(folder / name, content)
    print(f"{count} notebooks in {folder}; open them with: jupyter lab {quoted(str(folder))}")


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
