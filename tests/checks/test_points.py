"""The table of points agrees with the notebooks: exercises, checks, headings."""

import re
from itertools import pairwise

import pytest

from minislam import checks
from minislam.checks.points import EXERCISES
from tests.notebook_files import NOTEBOOKS, is_exercise, load, source

HEADING = re.compile(
    r"### Exercise (\d): [^\n]+ \((★{1,3})(☆{0,2}), (\d+) minutes, (\d) points\)\n"
)


def test_each_exercise_has_its_own_key_and_a_check():
    for rows in ([e.key for e in EXERCISES], [e.check for e in EXERCISES]):
        assert len(set(rows)) == len(rows)
    for exercise in EXERCISES:
        number = exercise.notebook.split("_")[0]
        assert re.fullmatch(rf"ex{number}_[1-9]", exercise.key)
        assert callable(getattr(checks, exercise.check))
        assert exercise.check in checks.__all__


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_headings_say_what_the_table_says(path):
    cells = load(path)["cells"]
    if not any(source(cell).startswith("### Exercise ") for cell in cells):
        pytest.skip("this notebook has no such headings yet")
    found = []
    for above, cell in pairwise(cells):
        if is_exercise(cell):
            heading = HEADING.match(source(above))
            assert heading and above["cell_type"] == "markdown", source(above)[:100]
            count, stars, no_stars, minutes, points = heading.groups()
            assert len(stars + no_stars) == 3
            assert source(above).rstrip().endswith("</details>"), "a folded hint is missing"
            check = re.findall(r"^checks\.(\w+)\(", source(cell), re.M)[-1]
            key = f"ex{path.stem.split('_')[0]}_{count}"
            found.append((key, path.stem, check, int(points), len(stars), int(minutes)))
    rows = [e for e in EXERCISES if e.notebook == path.stem]
    expected = [(e.key, e.notebook, e.check, e.points, e.stars, e.minutes) for e in rows]
    assert found == expected
