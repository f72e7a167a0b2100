"""`minislam settings`: every constant, or those that fit a pattern."""

import pytest

from minislam.cli.main import main
from minislam.config import SlamConfig, settings_of


def listing(capsys, *arguments: str) -> list[str]:
    assert main(["settings", *arguments]) == 0
    return capsys.readouterr().out.splitlines()


def test_every_setting_is_listed_with_default_and_meaning(capsys):
    lines = listing(capsys)
    heads = [line for line in lines if line.startswith("--")]
    assert [head.split()[0][2:] for head in heads] == list(settings_of(SlamConfig()))
    at = lines.index("--tracking.keyframe_flow 10.0  (at least 0)")
    assert lines[at + 1] == "    mean flow since the last keyframe that makes one [px]"


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("mask_min_sim", "--tracking.mask_min_similarity 0.9  (0 to 1)"),
        ("metric3d.size", "--networks.metric3d.size 616,1064  (at least 1; test 112,168)"),
        ("tracking.*mask", "--tracking.prior_mask on  (on or off; paper-fast off)"),
    ],
)
def test_a_pattern_is_part_of_a_name_or_a_glob(pattern: str, name: str, capsys):
    lines = listing(capsys, pattern)
    assert name in lines and len(lines) < 40


def test_a_narrow_terminal_gets_narrow_lines(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "3")
    assert max(map(len, listing(capsys, "window")[1:3])) <= 20


def test_a_pattern_that_nothing_fits_names_the_nearest(capsys):
    assert main(["settings", "tracking.windw"]) == 1
    assert "found 'tracking.windw' in none; the nearest is tracking.window" in (
        capsys.readouterr().err
    )
