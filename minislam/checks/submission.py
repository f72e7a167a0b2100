"""A student's notebook as parts that can be judged: imports, definitions, exercises.

Of every cell, only imports, definitions, plain constants and `torch.set_default_dtype` are kept,
and of an exercise all assignments to names: an exercise needs no more, and no figure is drawn.
"""

from __future__ import annotations

import ast
import re
from contextlib import suppress
from dataclasses import dataclass
from statistics import mode

from minislam.checks.points import EXERCISES, Exercise
from minislam.errors import InputError, require

SUBMITTED = "submitted_to_the_check"  # the name of what an exercise gives to its check
DEFINITIONS = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef)


@dataclass(frozen=True)
class Part:
    """What is kept of one cell, as Python text; an exercise keeps the line numbers of its cell."""

    text: str  # the whole cell where Python cannot read it
    key: str = ""  # of the exercise, "" for another cell


def exercises_of(notebook: dict, name: str) -> list[Exercise]:
    """Return the exercises that a notebook should hold, told by its checks or else by its name."""
    called = re.findall(r"\bcheck_\w+", "\n".join(_code(notebook)))
    number = name.split("_")[0]
    numbered = [e.notebook for e in EXERCISES if e.notebook.split("_")[0] == number]
    votes = [e.notebook for e in EXERCISES if e.check in called] or numbered
    found = f"none of its exercises in {name}; give one that `minislam notebooks` has made"
    require(bool(votes), "a notebook of the course", found)
    return [e for e in EXERCISES if e.notebook == mode(votes)]


def parts_of(notebook: dict, exercises: list[Exercise]) -> list[Part]:
    """Return the parts of a notebook, in its order."""
    return [_part(text, exercises) for text in _code(notebook)]


def _code(notebook: dict) -> list[str]:
    """Return the text of the code cells, without the lines that only a notebook understands.

    What Python can read is left as it is: a line of it may begin with the operator %.
    """
    try:
        cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        texts = ["".join(cell["source"]) for cell in cells]
    except (KeyError, TypeError) as error:
        found = f"{type(error).__name__} {error}; save it again"
        raise InputError(f"expected a notebook with cells, found {found}") from error
    plain = [re.sub(r"^[ \t]*[%!].*$", "", text, flags=re.M) for text in texts]
    return [text if _tree(text) else without for text, without in zip(texts, plain, strict=True)]


def _tree(text: str) -> ast.Module | None:
    with suppress(SyntaxError, ValueError):
        return ast.parse(text)
    return None


def _part(text: str, exercises: list[Exercise]) -> Part:
    tree = _tree(text)
    if tree is None:
        named = [e.key for e in exercises if re.search(rf"^checks\.{e.check}\(", text, re.M)]
        return Part(text, named[0] if named else "")
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    for exercise in exercises:
        for call in calls:
            if exercise.check in (getattr(call.func, "attr", ""), getattr(call.func, "id", "")):
                answer = ast.unparse(call.args[0]) if call.args else "None"
                kept = [node for node in tree.body if _is_kept(node, in_exercise=True)]
                lines = [*_only(text, kept), f"{SUBMITTED} = {answer}", ""]
                return Part("\n".join(lines), exercise.key)  # ends with a new line
    # Elsewhere, what fails is left out: a missing library matters only where it is used.
    passing = ast.ExceptHandler(ast.Name("Exception"), None, [ast.Pass()])
    tries = [ast.Try([node], [passing], [], []) for node in tree.body if _is_kept(node)]
    return Part("\n".join(map(ast.unparse, tries)))


def _is_kept(node: ast.stmt, in_exercise: bool = False) -> bool:
    if isinstance(node, ast.ImportFrom) and node.module == "__future__":
        return False
    if isinstance(node, ast.Assign | ast.AnnAssign) and node.value:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        is_constant = not any(isinstance(n, ast.Call | ast.Name) for n in ast.walk(node.value))
        is_named = all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
        return is_named and (is_constant or in_exercise)
    if isinstance(node, ast.Expr):
        return ast.unparse(node).startswith("torch.set_default_dtype(")
    return isinstance(node, DEFINITIONS)


def _only(text: str, nodes: list[ast.stmt]) -> list[str]:
    """Return the lines of a text, empty where they belong to none of the nodes."""
    kept: set[int] = set()
    for node in nodes:
        first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        kept |= set(range(first, (node.end_lineno or first) + 1))
    lines = re.split(r"\r\n?|\n", text)  # as Python counts; splitlines() cuts elsewhere as well
    return [line if number in kept else "" for number, line in enumerate(lines, start=1)]
