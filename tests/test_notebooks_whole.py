"""The notebooks in git are one clean run each, readable, and the student copies work too.

nbmake executes each stored notebook, once per test run. Here only the exercises are executed: a
student copy differs from the notebook in nothing else, and nothing else depends on them.
"""

import ast
import base64
import json
import re
from pathlib import Path

import pytest
import torch

from minislam.checks.grading import NOT_YET, PASSED
from minislam.checks.judge import judge
from minislam.checks.points import EXERCISES
from minislam.checks.submission import exercises_of, parts_of
from minislam.cli.notebooks import as_text, without_solutions
from tests.notebook_files import (
    NOTEBOOKS,
    ROOT,
    cleaned,
    code_cells,
    each_notebook,
    is_exercise,
    load,
    prose,
    source,
)

LARGEST = 2_000_000  # bytes
MOST_CELLS = 40
LONGEST_CELL = 600  # characters of code
LONGEST_SETUP = 900  # characters of imports, of a scene ("# Setup: ...") or of a warm-up
LONGEST_BUILDING = 2_000  # characters of an exercise that builds a part of the system
LONGEST_LINE = 100  # characters
LONGEST_TEXT = 180  # words, formulas and tables not counted
NARROWEST = 900  # pixels of a picture, so that it can be projected
LARGEST_PAGE = 400_000  # characters of a flipbook
FEWEST_REFERENCES = 3
WARM_UP = 2  # points
MACHINE_PATH = re.compile(r"(?<![\w.])(/home/|/Users/|/root/|/tmp/|[A-Z]:\\\\)")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy"),
]


@each_notebook
def test_it_is_stored_as_one_clean_run(path: Path):
    counts = [cell["execution_count"] for cell in code_cells(path)]
    assert counts == list(range(1, len(counts) + 1))
    kinds = [output["output_type"] for cell in code_cells(path) for output in cell["outputs"]]
    assert kinds and "error" not in kinds
    streams = [o for cell in code_cells(path) for o in cell["outputs"] if o.get("name") == "stderr"]
    assert not streams, "a warning is stored"


@each_notebook
def test_it_is_small_and_in_the_stored_form(path: Path):
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST
    assert text == as_text(cleaned(json.loads(text))), "run python -m tests.refresh_notebooks"
    assert load(path)["metadata"]["kernelspec"]["name"] == "python3"


def test_of_the_metadata_only_nbgraders_is_stored():
    grading = {"grade": True, "points": 2}
    cell = {"source": [], "metadata": {"nbgrader": grading, "execution": {"busy": "now"}}}
    stored = cleaned({"cells": [cell], "metadata": {"widgets": {}}})
    assert stored["cells"][0]["metadata"] == {"nbgrader": grading}
    assert set(stored["metadata"]) == {"kernelspec", "language_info"}


@each_notebook
def test_its_cells_are_short(path: Path):
    cells = load(path)["cells"]
    assert len(cells) <= MOST_CELLS
    imports = next(cell for cell in cells if cell["cell_type"] == "code")
    for cell in cells:
        text = source(cell)
        if cell["cell_type"] == "markdown":
            assert len(prose(text).split()) <= LONGEST_TEXT, text
            continue
        longest = LONGEST_CELL
        if cell is imports or text.startswith("# Setup") or is_exercise(cell):
            longest = LONGEST_SETUP
        if any(f"checks.{e.check}(" in text and e.points > WARM_UP for e in EXERCISES):
            longest = LONGEST_BUILDING
        assert len(text) <= longest, text
        assert max(map(len, text.splitlines())) <= LONGEST_LINE, text


@each_notebook
def test_its_code_has_one_statement_a_line_and_no_packed_assignment(path: Path):
    for cell in code_cells(path):
        statements = [node for node in ast.walk(ast.parse(source(cell))) if is_statement(node)]
        lines = [node.lineno for node in statements]
        assert len(set(lines)) == len(lines), source(cell)
        for node in statements:
            assert not is_packed(node), ast.unparse(node)


def is_statement(node: ast.AST) -> bool:
    return isinstance(node, ast.stmt)


def is_packed(node: ast.AST) -> bool:
    """Say whether a statement is `a, b = x, y`, `_ = x`, or several calls between commas."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Tuple)
    if not isinstance(node, ast.Assign):
        return False
    target = node.targets[0]
    if isinstance(target, ast.Name):
        return target.id == "_"
    return isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)


@pytest.mark.parametrize("line", ["_ = f()", "a, b = x, y", "a.set(), b.set()"])
def test_a_packed_line_is_seen(line: str):
    assert is_packed(ast.parse(line).body[0])


@each_notebook
def test_it_names_no_path_of_a_machine(path: Path):
    for cell in load(path)["cells"]:
        assert not MACHINE_PATH.search(source(cell)), source(cell)
        for output in cell.get("outputs", []):
            text = "".join(output.get("text", output.get("data", {}).get("text/plain", "")))
            assert not MACHINE_PATH.search(text), text


@each_notebook
def test_it_opens_like_a_lesson(path: Path):
    first = source(load(path)["cells"][0])
    assert re.match(r"# \d\db? ", first), "the title starts with the notebook's number"
    assert all(words in first for words in ("You will learn", "You need", "Time"))


@each_notebook
def test_its_pictures_can_be_projected_and_load_nothing(path: Path):
    for number, cell in enumerate(load(path)["cells"]):
        for data in (output["data"] for output in cell.get("outputs", []) if "data" in output):
            if "image/png" in data:
                header = base64.b64decode("".join(data["image/png"])[:64])
                width = int.from_bytes(header[16:20], "big")
                assert width >= NARROWEST, f"cell {number}: {width} px"
            page = "".join(data.get("text/html", ""))
            # Not "http" alone, which the letters of an image may spell by chance.
            assert len(page) < LARGEST_PAGE and "://" not in page, f"cell {number}"


@each_notebook
def test_a_map_in_colours_has_a_colour_bar(path: Path):
    for cell in code_cells(path):
        if "beta_to_rgb(" in source(cell):
            assert "viz.colour_bar(" in source(cell), source(cell)


@each_notebook
def test_a_symbol_stands_for_one_thing_and_is_used(path: Path):
    text = "\n".join(source(c) for c in load(path)["cells"] if c["cell_type"] == "markdown")
    if "$$" not in text:
        pytest.skip("this notebook has no displayed formula")
    match = re.search(r"\*\*Symbols\.\*\* (.+?)(?=\n\n|\Z)", text, re.S)
    assert match, 'expected a paragraph "**Symbols.**"'
    named = re.findall(r"\$([^$]+)\$ ", match[1].replace("\n", " "))
    symbols = [name.strip() for group in named for name in group.strip("()").split(",")]
    assert sorted(set(symbols)) == sorted(symbols) and len(symbols) > 3
    rest = text.replace(match[0], "")
    assert [name for name in symbols if name not in rest] == []


@each_notebook
def test_it_names_what_to_read_next(path: Path):
    text = "\n".join(map(source, load(path)["cells"]))
    references = text.partition("**Read more.**")[2]
    links = re.findall(r"\]\((https?://[^)\s]+)\)", references)
    assert len(set(links)) >= FEWEST_REFERENCES, links


@each_notebook
def test_every_check_has_passed_in_the_stored_run(path: Path):
    for cell in code_cells(path):
        if re.search(r"^checks\.", source(cell), re.M):
            answers = ["".join(o["data"]["text/plain"]) for o in cell["outputs"] if "data" in o]
            assert answers and answers[-1].startswith("Passed"), (source(cell), answers)


def test_the_student_copy_has_the_signature_and_no_solution():
    text = "def f(x: int) -> int:\n    ### BEGIN SOLUTION\n    return x\n    ### END SOLUTION\n"
    notebook = {"cells": [{"cell_type": "code", "source": [text], "outputs": [1]}]}
    stripped = source(without_solutions(notebook)["cells"][0])
    assert stripped == "def f(x: int) -> int:\n    raise NotImplementedError  # your code here\n"


@each_notebook
def test_each_exercise_passes_solved_and_says_not_yet_unsolved(path: Path, tmp_path: Path):
    solved = load(path)
    count = sum(map(is_exercise, solved["cells"]))
    if count == 0:
        pytest.skip("this notebook has no exercise")
    assert judged(solved, path, tmp_path) == [PASSED] * count
    student = without_solutions(solved)
    stubs = [cell for cell in student["cells"] if "NotImplementedError" in source(cell)]
    assert len(stubs) == count
    assert judged(student, path, tmp_path) == [NOT_YET] * count


def judged(notebook: dict, path: Path, folder: Path) -> list[str]:
    """Return what `minislam grade --no-package` says to each exercise, without a new process."""
    exercises = exercises_of(notebook, path.name)
    parts, rows = parts_of(notebook, exercises), []
    dtype = torch.get_default_dtype()
    judge(parts, folder, [exercise.key for exercise in exercises], True, rows.append)
    torch.set_default_dtype(dtype)
    return [row["status"] for row in rows if "status" in row]


@each_notebook
def test_only_pictures_depend_on_an_exercise_and_nothing_on_a_picture(path: Path):
    written = set()
    for cell in filter(is_exercise, code_cells(path)):
        *head, check = [n for n in ast.parse(source(cell)).body if not is_import(n)]
        assert all(isinstance(node, ast.FunctionDef) for node in head), source(cell)
        assert ast.unparse(check).startswith("checks."), source(cell)
        written |= {node.name for node in head if isinstance(node, ast.FunctionDef)}
    others = [ast.parse(source(cell)) for cell in code_cells(path) if not is_exercise(cell)]
    pictures = [tree for tree in others if function_of_picture(tree)]
    others = [tree for tree in others if tree not in pictures]
    elsewhere = set().union(*(names(tree, ast.Store) for tree in others))
    of_pictures = set().union(*(names(tree, ast.Store) for tree in pictures)) - elsewhere
    for tree in pictures:
        assert function_of_picture(tree) in written, ast.unparse(tree)
    for tree in others:
        assert not names(tree, ast.Load) & (written | of_pictures), ast.unparse(tree)


def function_of_picture(tree: ast.Module) -> str:
    """Return "f" for a cell that is one `if checks.is_written(f): ...`, else ""."""
    body = [node for node in tree.body if not is_import(node)]
    if len(body) != 1 or not isinstance(body[0], ast.If) or body[0].orelse:
        return ""
    match = re.fullmatch(r"checks\.is_written\((\w+)\)", ast.unparse(body[0].test))
    return match.group(1) if match else ""


def names(tree: ast.AST, context: type) -> set[str]:
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
    return {node.id for node in nodes if isinstance(node.ctx, context)}


def is_import(node: ast.AST) -> bool:
    return isinstance(node, ast.Import | ast.ImportFrom)


PACKAGE = {path: path.read_text(encoding="utf-8") for path in (ROOT / "minislam").rglob("*.py")}
FILES = [
    path.as_posix() for folder in ("minislam", "tests") for path in (ROOT / folder).rglob("*.py")
]


@each_notebook
def test_each_function_and_file_that_it_names_exists(path: Path):
    texts = [source(cell) for cell in load(path)["cells"] if cell["cell_type"] == "markdown"]
    named = " ".join(re.findall(r"`([^`\n]+)`", "\n".join(texts)))
    for name in re.findall(r"(?<![\w*/])\w[\w/]*\.py\b", named):
        assert any(file.endswith(f"/{name}") for file in FILES), name
    known = "\n".join([*PACKAGE.values(), code_of(path)])
    for name in re.findall(r"\b(?:[A-Za-z]+(?:_[a-z0-9]+)+|[A-Z][a-z]+[A-Z]\w+)\b(?!\.\w)", named):
        assert re.search(rf"\b{name}\b", known), name


def code_of(path: Path) -> str:
    return "\n".join(map(source, code_cells(path)))
