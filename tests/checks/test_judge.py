"""The judge runs the parts in order and lets no part's mischief count."""

from pathlib import Path

from minislam.checks import mapping
from minislam.checks.judge import judge
from minislam.checks.submission import Part

MINE = """
def mine(count, window, weight):
    if len(window) > weight * count:
        return [1 / count] * count
    rest = (1 - weight) / (count - len(window))
    return [weight / len(window) if k in window else rest for k in range(count)]

"""


def judged(folder: Path, *texts: str, alone: bool = False) -> list[tuple[str, str]]:
    """Return status and sentence of texts for exercise ex07_1, each a notebook of its own."""
    rows: list[dict] = []
    for text in texts:
        judge([Part(text, "ex07_1")], folder, ["ex07_1"], alone, rows.append)
    assert rows[::2] == [{"key": "ex07_1"}] * len(texts)
    return [(row["status"], row["sentence"]) for row in rows[1::2]]


def test_verdicts_are_those_of_the_check(tmp_path: Path):
    right, wrong, stub = judged(
        tmp_path,
        f"{MINE}submitted_to_the_check = mine",
        "submitted_to_the_check = lambda n, w, s: [1 / n] * n",
        "def f(n, w, s):\n    raise NotImplementedError\nsubmitted_to_the_check = f",
    )
    assert right[0] == "passed" and wrong[0] == "wrong" and stub[0] == "not yet"


def test_a_cell_that_stops_is_told_with_its_line(tmp_path: Path):
    broken, leaving, odd = judged(
        tmp_path,
        "\n\nsubmitted_to_the_check = nothing",
        "import sys\nsys.exit(0)",
        "submitted_to_the_check = 3",
    )
    assert broken == (
        "wrong",
        "the cell stops with NameError: name 'nothing' is not defined, in line 3: "
        "submitted_to_the_check = nothing.",
    )
    assert "stops with SystemExit: 0, in line 2" in leaving[1]
    assert odd[0] == "wrong" and "'int' object is not callable" in odd[1]


def test_what_is_missing_or_cannot_be_read_or_is_not_written_is_told(tmp_path: Path):
    rows: list[dict] = []
    judge([], tmp_path, ["ex07_1"], False, rows.append)
    assert [row["status"] for row in rows] == ["missing"]
    assert "the cell with checks.check_sampling(...) is missing: put it back." in str(rows)
    unread, unwritten = judged(tmp_path, "x = (", "raise NotImplementedError")
    assert unread[1].startswith(
        "the cell stops with SyntaxError: '(' was never closed (cell_1.py, line 1)."
    )
    assert unwritten == ("wrong", "the cell is not written yet.")


def test_calls_of_the_package_are_refused_where_they_are_not_allowed(tmp_path: Path):
    direct = "from minislam.mapping.window import sampling_probabilities as f\n"
    texts = (
        direct + "submitted_to_the_check = f",
        direct + "submitted_to_the_check = lambda *a: list(map(f, *zip(a)))[0]",
        "from minislam.geometry import se3_exp\nimport torch\n"
        f"{MINE}submitted_to_the_check = lambda *a: (se3_exp(torch.zeros(6)), mine(*a))[1]",
    )
    for status, sentence in judged(tmp_path, *texts[:2], alone=True):
        assert status == "refused"
        assert sentence == "the answer calls sampling_probabilities of minislam: write it yourself."
    assert judged(tmp_path, texts[2], alone=True)[0][0] == "passed"  # geometry is allowed
    assert {status for status, _ in judged(tmp_path, *texts)} == {"passed"}


def test_a_refused_function_is_refused_in_its_exercise_alone(tmp_path: Path):
    text = (
        "def mine(X, d, camera):\n    x, y, z = X.T\n"
        "    return camera.twist_jacobian(x / z, y / z, d / z).permute(2, 1, 0)\n"
        "submitted_to_the_check = mine"
    )
    rows: list[dict] = []
    judge([Part(text, "ex05_1")], tmp_path, ["ex05_1"], True, rows.append)
    assert rows[-1]["status"] == "refused" and "Camera.twist_jacobian" in rows[-1]["sentence"]


def test_a_notebook_that_replaces_the_packages_functions_is_refused(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(mapping, "sampling_probabilities", mapping.sampling_probabilities)
    text = (
        "from minislam.checks import mapping\n"
        "def mine(n, w, s):\n    return [0] * n\n"
        "def cheat(*a):\n    mapping.sampling_probabilities = mine\n    return mine(*a)\n"
        "submitted_to_the_check = cheat"
    )
    [(status, sentence)] = judged(tmp_path, text)
    assert status == "refused"
    assert sentence.endswith("minislam.checks.mapping.sampling_probabilities of the package.")
