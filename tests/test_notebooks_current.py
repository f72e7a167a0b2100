"""What the notebooks store is what the package is today: printed sources."""

import ast
import contextlib
import io
from pathlib import Path

from tests.notebook_files import NOTEBOOKS, code_cells, each_notebook, source


def names(node: ast.AST, context: type) -> set[str]:
    nodes = (n for n in ast.walk(node) if isinstance(n, ast.Name))
    return {n.id for n in nodes if isinstance(n.ctx, context)}


def listing(cell: dict) -> list[ast.stmt]:
    """Return the statements of a cell that print a source, and those they need."""
    found: list[ast.stmt] = []
    assigned: set[str] = set()
    for node in ast.parse(source(cell)).body:
        is_plain = isinstance(node, ast.Assign | ast.Expr)
        if is_plain and ("getsource" in ast.unparse(node) or names(node, ast.Load) & assigned):
            found.append(node)
            assigned |= names(node, ast.Store)
    return found


@each_notebook
def test_stored_sources_are_those_of_the_package(path: Path):
    namespace: dict = {}
    for cell in code_cells(path):
        imports = [
            node
            for node in ast.parse(source(cell)).body
            if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        exec("\n".join(map(ast.unparse, imports)), namespace)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec("\n".join(map(ast.unparse, listing(cell))), namespace)
        stored = "".join("".join(output.get("text", [])) for output in cell["outputs"])
        assert printed.getvalue() in stored, f"python -m tests.refresh_notebooks {path.stem[:3]}"


def test_a_listing_is_found_with_what_it_needs():
    text = "x = 3\nlines = getsource(f).splitlines()\nprint(lines[2])\nprint(x)\n"
    assert len(listing({"source": [text]})) == 2
    if NOTEBOOKS:
        assert sum(bool(listing(cell)) for path in NOTEBOOKS for cell in code_cells(path)) >= 8
