"""Notebooks as files: where they are, and how one is stored."""

import copy
import json
import re
from pathlib import Path

import pytest

from minislam.cli.notebooks import SOLUTION

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def load(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def code_cells(path: Path) -> list[dict]:
    return [cell for cell in load(path)["cells"] if cell["cell_type"] == "code"]


def source(cell: dict) -> str:
    return "".join(cell["source"])


def is_exercise(cell: dict) -> bool:
    return cell["cell_type"] == "code" and SOLUTION.search(source(cell)) is not None


def prose(text: str) -> str:
    """Return the sentences of a text cell: no code blocks, displayed formulas and tables."""
    return re.sub(r"```.*?```|\$\$.*?\$\$|^\|.*?$", "", text, flags=re.S | re.M)


def cleaned(notebook: dict) -> dict:
    """Return the notebook without what differs from run to run: timings, versions, random ids."""
    result = copy.deepcopy(notebook)
    for number, cell in enumerate(result["cells"]):
        if "outputs" in cell:
            cell["outputs"] = with_joined_streams(cell["outputs"])
        # Points for nbgrader may stay: they are no trace of a run.
        cell["metadata"] = {k: v for k, v in cell["metadata"].items() if k == "nbgrader"}
        cell["id"] = f"cell-{number:02d}"
    result["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    result["nbformat"], result["nbformat_minor"] = 4, 5
    return result


def with_joined_streams(outputs: list[dict]) -> list[dict]:
    """Join neighbouring prints: into how many pieces a kernel cuts them depends on timing."""
    joined: list[dict] = []
    for output in outputs:
        if joined and "name" in output and output["name"] == joined[-1].get("name"):
            text = "".join([*joined[-1]["text"], *output["text"]])
            joined[-1]["text"] = text.splitlines(keepends=True)
        else:
            joined.append(output)
    return joined
