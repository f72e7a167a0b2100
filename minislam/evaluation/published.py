"""The ATE that the paper prints for each system it compares with, and ours beside it.

Columns of published.csv: table (of the paper; 8 and 10 are in the supplement, counted on); dataset;
sequence, as printed, "Avg." for the printed mean; folder, as the makers of the sequence call it;
input of the system; system; ate_cm, as printed: RMSE over all frames [cm], F failed, - not
reported, * run by the authors of the paper.
"""

import csv
from pathlib import Path

OTHER = "other sequences"  # that the paper has no number for


def published_errors() -> list[dict[str, str]]:
    """Return the rows of published.csv, in the paper's order."""
    text = Path(__file__).with_name("published.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def compare(ours: dict[str, str]) -> dict[str, list[list[str]]]:
    """Return for each dataset a table: a header, the published systems, minislam.

    `ours` has an ATE [cm] for each sequence, by the name of its folder, written as in the paper. A
    mean is over the columns shown, "-" where one of them has no number.
    """
    rows, tables = published_errors(), {}
    known = {plain_name(row["folder"]): row for row in rows}
    datasets: dict[str, dict[str, str]] = {}  # dataset: {sequence: ours}
    for name, ate_cm in ours.items():
        row = known.get(plain_name(name), {"dataset": OTHER, "sequence": name})
        datasets.setdefault(row["dataset"], {})[row["sequence"]] = ate_cm
    for dataset, mine in datasets.items():
        systems: dict[tuple[str, str], dict[str, str]] = {}
        for row in rows:
            if row["dataset"] == dataset and row["sequence"] in mine and row["ate_cm"] != "-":
                key = row["system"], row["input"]
                systems.setdefault(key, dict.fromkeys(mine, "-"))[row["sequence"]] = row["ate_cm"]
        systems["minislam", "Monocular"] = mine
        lines = [[*key, *row.values(), _mean(list(row.values()))] for key, row in systems.items()]
        tables[dataset] = [["ATE [cm]", "input", *mine, "mean"], *lines]
    return tables


def plain_name(folder: str) -> str:
    """Return the name of a sequence as one folder of it or another is called."""
    return folder.casefold().removeprefix("rgbd_dataset_")


def _mean(cells: list[str]) -> str:
    try:
        return f"{sum(float(cell.rstrip('*')) for cell in cells) / len(cells):.2f}"
    except ValueError:  # a failure, or a number that is not known
        return "-"
