"""The table of points agrees with the notebooks: exercises, checks, headings; and the syllabus.

`python -m tests.checks.test_points` rewrites the table of notebooks/SYLLABUS.md.
"""

import re
from itertools import pairwise
from pathlib import Path

import pytest

from minislam import checks
from minislam.checks.points import EXERCISES, Exercise
from tests.notebook_files import NOTEBOOKS, ROOT, each_notebook, is_exercise, load, source

SYLLABUS = ROOT / "notebooks/SYLLABUS.md"
GENERATED = re.compile(r"(<!-- points: [^\n]+ -->\n).*?(<!-- end of points -->)", re.S)
WARM_UP = 2  # points
HEADING = re.compile(
    r"(?:## [^\n]+\n\n)?"  # a section may begin here
    r"### Exercise (\d): [^\n]+ \((★{1,3})(☆{0,2}), (\d+) minutes, (\d) points\)\n"
)


def test_each_exercise_has_its_own_key_and_a_check():
    for rows in ([e.key for e in EXERCISES], [e.check for e in EXERCISES]):
        assert len(set(rows)) == len(rows)
    for exercise in EXERCISES:
        number = exercise.notebook.split("_")[0]
        assert re.fullmatch(rf"ex{number}_[1-9]", exercise.key)
        assert callable(getattr(checks, exercise.check))


def test_each_exercise_has_marked_tests():
    texts = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py")]
    marked = set(re.findall(r"^@pytest\.mark\.(ex\w+)$", "\n".join(texts), re.M))
    assert marked == {exercise.key for exercise in EXERCISES}


def exercises_in(path: Path) -> list[tuple[Exercise, int]]:
    """Return the exercises of a notebook and their minutes, as their headings say."""
    found = []
    for above, cell in pairwise(load(path)["cells"]):
        if is_exercise(cell):
            heading = HEADING.match(source(above))
            assert heading and above["cell_type"] == "markdown", source(above)[:100]
            count, stars, no_stars, minutes, points = heading.groups()
            assert len(stars + no_stars) == 3
            assert source(above).rstrip().endswith("</details>"), "a folded hint is missing"
            check = re.findall(r"^checks\.(\w+)\(", source(cell), re.M)[-1]
            key = f"ex{path.stem.split('_')[0]}_{count}"
            found.append((Exercise(key, path.stem, check, int(points)), int(minutes)))
    return found


@each_notebook
def test_headings_say_what_the_table_says(path):
    rows = [e for e in EXERCISES if e.notebook == path.stem]
    assert [exercise for exercise, _ in exercises_in(path)] == rows


def table_of_points() -> str:
    rows = ["| notebook | warm-ups | building | points | minutes |", "|---|---|---|---|---|"]
    for path in NOTEBOOKS:
        own = exercises_in(path)
        warm = sum(e.points == WARM_UP for e, _ in own)
        points, minutes = sum(e.points for e, _ in own), sum(spent for _, spent in own)
        rows.append(f"| {path.stem} | {warm} | {len(own) - warm} | {points} | {minutes} |")
    first = sum(e.points for e in EXERCISES if e.notebook < "05")
    whole = sum(e.points for e in EXERCISES)
    last = f"Hand-in 1 (00 to 04): {first} points. Hand-in 2 (05 to 10): {whole - first} points."
    return "\n".join([*rows, "", last, ""])


def test_the_syllabus_counts_the_same_points():
    if not SYLLABUS.exists():
        pytest.skip("no notebooks in this copy")
    text = SYLLABUS.read_text(encoding="utf-8")
    assert written(text) == text, "run python -m tests.checks.test_points"


def written(text: str) -> str:
    return GENERATED.sub(lambda match: match[1] + table_of_points() + match[2], text)


def write_syllabus() -> None:
    SYLLABUS.write_text(written(SYLLABUS.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    write_syllabus()
