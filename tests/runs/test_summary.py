"""The summary: what is known in words, with units, and whether it is good."""

import csv
from importlib.resources import files

import pytest

from minislam.runs.summary import as_text, judge, summarise

FACTS = {
    "frames": 60,
    "lost_frames": 3,
    "unread_images": 0,
    "breaks": [],
    "keyframes": 14,
    "gaussians": 14083,
    "unit": "m",
    "focal_length": {"used": "272.0 px for 320x240 images, as given"},
    "readout_seconds": [0.0, 0.0261],
    "frame_seconds": 0.033,
    "seconds": {"total": 94.4, "tracking": 8.2, "mapping": 20.0, "final adjustment": 0.1},
}


def lines(metrics: dict | None = None, **facts: object) -> dict[str, tuple[str, str, str]]:
    found = summarise(metrics or {}, FACTS | facts)
    return {line.what: (line.value, line.verdict, line.detail) for line in found}


def test_what_is_not_known_is_not_shown():
    assert list(lines({"ate_all_cm": None, "psnr_static_db": None})) == [
        "frames followed", "keyframes", "Gaussians in the map", "focal length", "rolling shutter",
        "time",
    ]  # fmt: skip


def test_numbers_have_units_words_and_verdicts():
    found = lines({"path_length": 2.768, "reprojection_px": 0.0987, "psnr_static_db": 17.0})
    assert found["frames followed"] == ("57 of 60", "fair", "")
    assert found["Gaussians in the map"][0] == "14,083"
    assert found["path of the camera"] == ("2.77 m", "", "")
    assert found["reprojection error, median"] == ("0.10 px", "good", "")
    assert found["map against input, static pixels"] == ("17.0 dB", "poor", "")
    assert lines({"guessed_depth": 0.78})["static pixels of guessed depth"] == ("0.78", "poor", "")
    between = "of a frame's time,"
    assert found["rolling shutter"] == ("79%", "", f"{between} top to bottom")
    across = lines(readout_seconds=[-0.02, 0.0], frame_seconds=0.04)["rolling shutter"]
    assert across == ("50%", "", f"{between} right to left")
    assert "rolling shutter" not in lines(readout_seconds=[0.0, 0.0])
    assert found["time"] == ("94 s", "", "mapping 20 s, tracking 8 s")
    assert lines({"path_length": 1.0}, unit="world units")["path of the camera"][0] == (
        "1.00 world units"
    )


def test_images_left_out_are_said():
    assert lines(unread_images=11)["images left out"] == ("11", "poor", "")


def test_fog_of_guessed_depth_is_poor():
    verdicts = [lines({"guessed_depth": value}) for value in (0.2, 0.5, 0.96)]
    what = "static pixels of guessed depth"
    assert [found[what][1] for found in verdicts] == ["good", "fair", "poor"]


def test_a_broken_trajectory_is_said():
    breaks = [{"first_frame": 4, "last_frame": 9}]
    assert lines(breaks=breaks)["broken at frames"] == ("4 to 9", "poor", "")
    breaks += [{"first_frame": 12, "last_frame": 12}]
    assert lines(breaks=breaks)["broken at frames"][0] == "4 to 9, 12"


@pytest.mark.parametrize(("doubtful", "verdict"), [(False, "good"), (True, "poor")])
def test_the_check_of_the_focal_length_is_said(doubtful: bool, verdict: str):
    assert lines()["focal length"] == ("272.0 px", "", "as given")
    checked = FACTS["focal_length"] | {"factor": 1.1, "is_doubtful": doubtful}
    whole = {"focal_length": checked, "lost_frames": 0, "breaks": []}
    found = lines(**whole)["focal length"]
    assert found == ("272.0 px", verdict, "as given; the flow fits 1.10 times this one best")
    whole["focal_length"] = checked | {"half": [30, 59]}
    assert "; from frame 30 to 59 the flow fits" in lines(**whole)["focal length"][2]
    for broken in ({"breaks": [{"first_frame": 4, "last_frame": 9}]}, {"lost_frames": 2}):
        assert lines(**whole | broken)["focal length"] == ("272.0 px", "", "as given")


@pytest.mark.parametrize(
    ("value", "bounds", "verdict"),
    [
        (25.0, (22.0, 18.0), "good"),
        (22.0, (22.0, 18.0), "good"),
        (20.0, (22.0, 18.0), "fair"),
        (18.0, (22.0, 18.0), "fair"),
        (17.9, (22.0, 18.0), "poor"),
        (0.4, (0.5, 1.0), "good"),  # less is better
        (0.8, (0.5, 1.0), "fair"),
        (2.0, (0.5, 1.0), "poor"),
        (2.0, (None, None), ""),
    ],
)
def test_more_or_less_is_better_by_the_order_of_the_bounds(value, bounds, verdict):
    assert judge(value, *bounds) == verdict


def test_the_terminal_gets_columns_without_explanations():
    text = as_text(summarise({"reprojection_px": 0.1}, FACTS))
    assert text[0] == "  frames followed                    57 of 60       fair"
    assert (
        text[-1]
        == "  time                               94 s                 mapping 20 s, tracking 8 s"
    )
    assert max(map(len, text)) < 100
    table = files("minislam.runs").joinpath("measures.csv").read_text(encoding="utf-8")
    assert max(len(row["words"]) for row in csv.DictReader(table.splitlines())) < 35  # a gap
