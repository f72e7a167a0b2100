"""What type checkers are told of the names that the package offers; mypy itself is not needed."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "minislam"
PARTS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def body_of(path: Path) -> list[ast.stmt]:
    return ast.parse(path.read_text(encoding="utf-8")).body


@pytest.mark.parametrize("part", PARTS)
def test_what_a_part_imports_for_others_it_exports(part: str):
    imports = [n for n in body_of(PACKAGE / part / "__init__.py") if isinstance(n, ast.ImportFrom)]
    names = [alias.name for node in imports for alias in node.names]
    assert sorted(names) == sorted(getattr(import_module(f"minislam.{part}"), "__all__", []))


def test_a_misspelt_name_of_the_package_is_unknown():
    functions = [n.name for n in body_of(PACKAGE / "__init__.py") if isinstance(n, ast.FunctionDef)]
    assert "__getattr__" not in functions  # below `if not TYPE_CHECKING`
