"""The exercises of the course and what each is worth: points.csv has a row for each.

`minislam grade` counts with this table. A test compares it with the headings of the notebooks,
which also say how hard an exercise is: "### Exercise 2: title (★★☆, 10 minutes, 2 points)".
"""

import csv
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Exercise:
    """One exercise of a notebook."""

    key: str  # "ex03_2": notebook 03, second exercise; also the pytest marker
    notebook: str  # file name without .ipynb
    check: str  # name in minislam.checks
    points: int  # warm-ups have 2, building exercises 8


_TABLE = Path(__file__).with_name("points.csv").read_text(encoding="utf-8")
EXERCISES = tuple(
    Exercise(row["key"], row["notebook"], row["check"], int(row["points"]))
    for row in csv.DictReader(_TABLE.splitlines())
)

# For `minislam grade --no-package`: an answer may call all of minislam.geometry, and what is named
# here, less what is refused. Names as Python prints them: "Camera.resized".
MAY_CALL = {
    "ex04_3": "UncertaintyMLP.forward",
    "ex05_3": "relative_transforms reproject reproject_with_jacobians",
    "ex06_1": "relative_transforms reproject",
    "ex06_3": "composed_flow reverse_flow warp",
    "ex06b_2": "reproject filled_from_nearest",
    "ex07_5": "render _Render.backward curvature",
}
MAY_NOT_CALL = {
    "ex01_1": "Camera.resized",
    "ex05_1": "Camera.twist_jacobian",
    "ex08_3": "umeyama",
}
