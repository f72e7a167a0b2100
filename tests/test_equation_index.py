"""README's equation index, reading path, line counts and minutes are true, and README stays short.

python -m tests.test_equation_index    writes the line counts into README as they are
"""

import ast
import re
from pathlib import Path

import pytest

from tests.notebook_files import NOTEBOOKS, load, source

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "minislam"
README = (ROOT / "README.md").read_text(encoding="utf-8")
MODULES = sorted(PACKAGE.rglob("*.py"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", PACKAGE / "DIFFERENCES.md"]
DOCUMENTS += [ROOT / "tests/benchmarks/RESULTS.md", PACKAGE / "priors/networks/README.md"]
DOCUMENTS += sorted((ROOT / "tests/benchmarks/diary").glob("*.md"))

MOST_WORDS = 1300  # of README, outside tables
MOST_LINES = 150  # of README, besides tables
PAPER_BUDGET = 5_410
PACKAGE_BUDGET = 22_369
PAPER_PACKAGES = ("splatting", "uncertainty", "tracking", "mapping", "slam.py")
BESIDE_THE_PAPER = (
    "tracking/safeguards/",
    "mapping/safeguards.py",
    "mapping/gaps.py",
    "/config.py",
)

LABEL = re.compile(r"Eq\. \((\d)\)")
LIKE_A_LABEL = re.compile(r"\b([Ee]qs?\b\.?|[Ee]quations?)\s*\(?\d(?![\d.])")
STATED_SIZES = (  # of the paper's packages, the package, the reading path
    r"(paper's packages have about )[\d,]*\d",
    r"(the\swhole\spackage\sabout\s)[\d,]*\d",
    r"(to every equation has )[\d,]*\d",
)
FUNCTION = re.compile(r"`([\w/]+\.py): (\w+)`")


def rows_below(heading: str) -> list[list[str]]:
    """Return the cells of README's table whose first row starts with `heading`."""
    table = README[README.index(f"\n{heading}") + 1 :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table[2:]]


def line_count(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def in_package(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def is_of_the_paper(path: Path) -> bool:
    """Return whether a module belongs to the paper's packages."""
    name = in_package(path)
    is_beside = any(part in name for part in BESIDE_THE_PAPER)
    return name.split("/")[0] in PAPER_PACKAGES and not is_beside


def paper_lines() -> int:
    return sum(line_count(path) for path in MODULES if is_of_the_paper(path))


def package_lines() -> int:
    return sum(line_count(path) for path in MODULES)


def docstring_of(module: str, function: str) -> str:
    """Return the docstring of a function of minislam; fails where there is none of that name."""
    tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
    found = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == function]
    assert len(found) == 1, f"expected one function {function} in {module}, found {len(found)}"
    return ast.get_docstring(found[0]) or ""


def rounded(lines: int) -> str:
    return f"{round(lines, -2):,}"


INDEX = rows_below("| paper | to read |")
PATH = rows_below("| file | lines |")


# The equation index

each_equation = pytest.mark.parametrize("row", INDEX, ids=lambda row: row[0])


def test_the_index_has_every_equation_of_the_paper():
    numbers = [number for row in INDEX for number in re.findall(r"^\((\d)\)", row[0])]
    assert numbers == list("12345678")


@each_equation
def test_indexed_functions_exist_and_carry_the_label(row: list[str]):
    functions = FUNCTION.findall(row[1] + row[2])
    assert functions and FUNCTION.findall(row[1]), f"{row[0]} names no function to read"
    number = re.match(r"\((\d)\)", row[0])
    for module, function in functions:
        labels = LABEL.findall(docstring_of(module, function))
        assert not number or number[1] in labels, f"{module}: {function} lacks Eq. {number[0]}"


@each_equation
def test_indexed_tests_and_notebooks_exist(row: list[str]):
    tests = re.findall(r"`([\w/]+\.py)`", row[3])
    assert tests and all((ROOT / "tests" / test).exists() for test in tests), tests
    numbers = row[4].split(", ")
    assert set(numbers) <= {path.stem.split("_")[0] for path in NOTEBOOKS}, numbers


@pytest.mark.parametrize("path", MODULES, ids=in_package)
def test_labels_have_one_form(path: Path):
    for line in path.read_text(encoding="utf-8").splitlines():
        other = LIKE_A_LABEL.search(LABEL.sub("", line))
        assert not other, f"expected Eq. (n), found {line.strip()!r}"
        assert all(label in "12345678" for label in LABEL.findall(line)), line


# The reading path and the line counts


def test_readme_counts_lines_as_they_are():
    assert all(re.search(pattern, README) for pattern in STATED_SIZES)
    assert with_line_counts(README) == README, "run python -m tests.test_equation_index"


def test_the_reading_path_holds_what_the_index_says_to_read():
    files = {row[0].strip("`") for row in PATH[:-1]}
    for row in INDEX:
        assert {module for module, _ in FUNCTION.findall(row[1])} <= files, row[0]


def test_the_paper_and_the_package_keep_their_budgets():
    assert paper_lines() <= PAPER_BUDGET
    assert package_lines() <= PACKAGE_BUDGET


@pytest.mark.skipif(not NOTEBOOKS, reason="no notebooks in this copy")
def test_a_notebook_names_every_public_function_of_the_reading_path():
    cells = [cell for path in NOTEBOOKS for cell in load(path)["cells"]]
    words = set(re.findall(r"\w+", "\n".join(map(source, cells))))
    for name, *_ in PATH[:-1]:
        tree = ast.parse((PACKAGE / name.strip("`")).read_text(encoding="utf-8"))
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        missing = {function for function in functions - words if function[0] != "_"}
        assert not missing, f"expected a notebook that names {missing} of {name}"


# README and the other documents


def test_the_tests_of_what_readme_promises_exist():
    *promises, not_promised = rows_below("| promise | test |")
    assert not_promised[0].startswith("Not promised: ")
    for promise, tests in promises:
        named = re.findall(r"`([\w/]+\.py)(?:: (\w+))?`", tests)
        assert named, promise
        for module, function in named:
            text = (ROOT / "tests" / module).read_text(encoding="utf-8")
            assert f"\ndef {function}" in text, f"{module} has no {function}"


def test_readme_is_short():
    text = [line for line in README.splitlines() if not line.startswith("|")]
    assert len(" ".join(text).split()) <= MOST_WORDS
    assert len(text) <= MOST_LINES


def test_readme_says_the_minutes_that_the_notebooks_say():
    stated = {row[0].split("](")[1].strip(")"): row[3] for row in rows_below("| notebook |")}
    found = {}
    for path in NOTEBOOKS:
        first, *others = map(source, load(path)["cells"])
        time = re.search(r"\*\*Time\*\* (\d+) minutes to read, (\d+) for the exercises", first)
        assert time, f"{path.name} does not say its time"
        found[f"notebooks/{path.name}"] = f"{time[1]} + {time[2]}"
        exercises = re.findall(r"^### Exercise .*, (\d+) minutes", "\n".join(others), re.M)
        assert int(time[2]) == sum(map(int, exercises))
    assert stated == found


def sections(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)", document.read_text(encoding="utf-8"), re.M)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_files_that_a_document_names_exist(document: Path):
    text = document.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        file, _, section = link.partition("#")
        if "://" not in link:
            target = document.parent / file if file else document
            assert target.exists(), link
            assert not section or section in sections(target), link
    for name in re.findall(r"`([\w./]+/\w+\.(?:py|md|ipynb))[`:]", text):
        places = [ROOT / name, PACKAGE / name, ROOT / "tests" / name]
        assert any(place.exists() for place in places), f"{document.name} names {name}"


def with_line_counts(readme: str) -> str:
    """Return README with the line counts as they are."""
    total = 0
    for name, stated, *_ in PATH[:-1]:
        lines = line_count(PACKAGE / name.strip("`"))
        total += lines
        readme = readme.replace(f"| {name} | {stated} |", f"| {name} | {lines} |")
    last = f"| {PATH[-1][0]} | {PATH[-1][1]} |"
    readme = readme.replace(last, f"| {len(PATH) - 1} files | {total:,} |")
    sizes = (paper_lines(), package_lines(), total)
    for pattern, lines in zip(STATED_SIZES, sizes, strict=True):
        readme = re.sub(pattern, lambda found, n=lines: found[1] + rounded(n), readme)
    return readme


if __name__ == "__main__":
    (ROOT / "README.md").write_text(with_line_counts(README), encoding="utf-8")
    print(f"the paper's packages: {paper_lines():,} lines; minislam: {package_lines():,} lines")
