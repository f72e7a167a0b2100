"""Run notebooks from top to bottom and store them with their outputs; count the syllabus's points.

python -m tests.refresh_notebooks                    all of them
python -m tests.refresh_notebooks 01 03              those whose names start so
"""

import os
import subprocess
import sys
from pathlib import Path

from minislam.cli.notebooks import as_text
from tests.checks.test_points import write_syllabus
from tests.notebook_files import NOTEBOOKS, ROOT, cleaned, load


def execute(path: Path) -> None:
    """Run a notebook in a fresh kernel and store it in place."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    environment.pop("MPLBACKEND", None)  # another one draws no pictures into the notebook
    command = [sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", "--inplace"]
    subprocess.run([*command, "--log-level=WARN", str(path)], check=True, env=environment)
    store(path, cleaned(load(path)))


def store(path: Path, notebook: dict) -> None:
    temporary = path.with_suffix(".tmp")
    temporary.write_text(as_text(notebook), encoding="utf-8")
    os.replace(temporary, path)


def main(arguments: list[str]) -> None:
    for path in NOTEBOOKS:
        if not arguments or path.name.startswith(tuple(arguments)):
            print(path.name, flush=True)
            execute(path)
    write_syllabus()


if __name__ == "__main__":
    main(sys.argv[1:])
