"""Each thing that the user must know of a run is one warning, and a good run has none."""

from collections.abc import Sequence
from types import SimpleNamespace

import pytest
import torch

from minislam.config import with_settings
from minislam.records import TrackingStatus
from minislam.runs.warnings import warnings
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.safeguards.diagnostics import Break
from minislam.tracking.safeguards.focal_length import FocalLengthFit
from minislam.tracking.safeguards.lens import LensFit
from tests.runs.finished import finished

DOUBTFUL = FocalLengthFit(272.0, 1.1, 0.25)
ZOOMED = FocalLengthFit(272.0, 1.4, 0.52, half=(8, 15))
WARNINGS = [
    (
        {"lost": [3]},
        "1 of 20 frames could not be tracked and have no pose; lost_frames.txt lists them. If the",
    ),
    # The run begins at image 10 and takes every third. Too few frames cannot start by themselves.
    (
        {"lost": range(14, 20)},
        "film is cut there, run the rest by itself: --start 52 --max-frames 6. If the images lie",
    ),
    (
        {"lost": [*range(2, 9), 11, *range(13, 20)]},
        "rest by itself: --start 16 --max-frames 7, or --start 49 --max-frames 7. If the",
    ),
    ({"breaks": [Break(2, 2)]}, "broken at frames 2: motion"),
    (
        {"breaks": [Break(2, 2)]},
        "run each piece anew, with the other options as here: --start 10 --max-frames 6. If",
    ),
    (
        {"breaks": [Break(9, 9)], "segments": [(0, 8), (10, 19)]},
        "options as here: --start 10 --max-frames 9, or --start 40 --max-frames 10. If",
    ),
    (
        {"breaks": [Break(9, 9)], "mapped": range(10, 20)},
        "do not belong together, so the map shows frames 10 to 19 alone; run each piece",
    ),
    (
        {"breaks": [Break(9, 9)], "mapped": [*range(3), *range(16, 20)]},
        "so the map shows frames 0 to 2 and 16 to 19 alone; run each piece",
    ),
    ({"breaks": [Break(9, 9)]}, "do not belong together; run each piece"),
    (
        {"truth": [9.0, 9.5]},
        "there is no ATE: expected at least 3 timestamps of estimate and truth",
    ),
    ({"truth": [0.0]}, "found 1 (estimate 4 poses, 0.000 to 0.100 s, truth 1 pose, 0.000 to 0.000"),
    ({"truth": [0.0, 33.0, 67.0]}, "check that the times of both are in seconds: poses of the est"),
    ({"truth": [k / 30 for k in range(3)], "stands": True}, "or a camera that does not move"),
    ({"truth": [0.0, 1 / 30, 1 / 15, 50.0, 90.0, 130.0]}, "check that the times of both are in se"),
    ({"breaks": [Break(2, 2)]}, "there is too little parallax to carry the scale across, or the"),
    ({"failed": 3}, "3 of 5 bundle adjustments failed"),
    ({"failed": 3}, "their poses and depths stay as first guessed, so do not trust them; try"),
    ({"shown": [0.8, 0.4]}, "the map shows only 60% of what stands still, least in frame 8"),
    (
        {"lens": LensFit(300.0, (-0.1, 0.0), -0.07, 0.13)},
        "bends straight lines, the corners by -7%, with 13% less",
    ),
    ({"lens": LensFit(300.0, (-0.1, 0.0), -0.07, 0.13)}, "or give --fx, --k1 and --k2"),
    (
        {"lens": LensFit(300.0, (0.0, 0.0), 0.01, 0.13), "focal_length": DOUBTFUL},
        "the flow fits 1.10 times the",
    ),
    (
        {"undone_lens": LensFit(300.0, (-0.1, 0.02), -0.07, 0.13)},
        "by -7%: the run begins anew on straightened images, k1 = -0.100, k2 = 0.020",
    ),
    ({"focal_length": DOUBTFUL}, "the flow fits 1.10 times the present focal length better"),
    ({"focal_length": ZOOMED}, "from frame 8 to 15 the flow fits 1.40 times the present focal"),
    (
        {"seeks_focal": True},
        "the motion does not tell it: trajectory and map may be bent; give --fx",
    ),
    (
        {"seeks_focal": True, "focal_origin": "QuickTime tag of a.mov"},
        "is known from QuickTime tag of a.mov alone and the motion does not tell it: traj",
    ),
    (
        {"seeks_focal": True, "focal_is_free": True, "fx": 1500.0},
        "times the first one, a view of 12 degrees: unless the lens has it, path and depth",
    ),
    (
        {"seeks_focal": True, "focal_is_free": True, "fx": 60.0},
        "found to be 0.2 times the first one, a view of 139 degrees: unless",
    ),
    # Half of the run tells 1.4 times 272 px of images that are half as large as the raw ones.
    (
        {"seeks_focal": True, "focal_length": ZOOMED},
        "tell it, but from frame 8 to 15 the flow fits --fx 762 best, with 52% less cost: traj",
    ),
    (
        {"seeks_focal": True, "focal_length": ZOOMED},
        "give --fx or a calibration file; if the lens zoomed, run each part for itself",
    ),
    ({"parallax": [0.1, 0.2, 5.0]}, "2 of 3 keyframes show hardly any parallax"),
    ({"parallax": [0.1, 5.0]}, "1 of 2 keyframes show hardly any parallax"),
    ({"parallax": [0.1], "knows_depth": False}, "and all that the map shows is at one depth"),
    ({"focal_length": DOUBTFUL}, "If the lens zoomed while it filmed, no focal length is right"),
    ({"overlay": torch.tensor([0.0, 1, 1, 1])}, "25% of the image stand still while the rest mov"),
    ({"left_out": 0.5}, "beta takes 50% of all pixels for moving"),
    ({"unknown": 0.8}, "no view measured the depth of 80% of what stands still: it is filled from"),
    ({"has_prior": False}, "the unit of length is arbitrary"),
]


@pytest.mark.parametrize(("parts", "words"), WARNINGS)
def test_each_fault_is_one_warning(parts: dict, words: str):
    assert not list(warnings(finished()))
    (warning,) = warnings(finished(**parts))
    assert words in warning


def test_masks_that_cover_much_are_not_blamed_on_beta():
    run = finished(left_out=0.5)
    run.config = with_settings(run.config, {"uncertainty.given_masks": True})
    (warning,) = warnings(run)
    assert "the masks cover 50% of all pixels" in warning and "beta" not in warning


def test_a_lens_that_was_found_is_not_said_to_be_given():
    lens = LensFit(300.0, (-0.1, 0.02), -0.07, 0.13)
    run = finished(undone_lens=lens, seeks_focal=True, focal_origin="intrinsics given")
    assert "is known from the lens that the flow fits alone and" in list(warnings(run))[1]


def test_keyframes_without_depth_are_warned_of_where_a_prior_was_given():
    run = finished()
    run.tracker.keyframes = KeyframeStore(torch.zeros(2))
    for frame, depths in ((0, [0.5, 0.0]), (8, [0.0, 0.0]), (16, [0.0, 0.0])):
        row = SimpleNamespace(frame_index=frame, pixels=None), torch.zeros(1), None, torch.eye(4)
        run.tracker.keyframes.append(*row, torch.ones(2), torch.tensor(depths))
    assert not list(warnings(run, "none"))
    (warning,) = warnings(run, "files:made")
    assert "--depth files:made knows nothing of 2 of 3 keyframes, such as frame 8:" in warning


def test_a_truth_that_frames_match_is_not_warned_of():
    assert not list(warnings(finished(truth=[k / 30 for k in range(3)])))


def test_flow_that_is_hardly_more_than_a_turn_is_warned_of_where_no_prior_tells_depth():
    weak = {"hardly_walked": True}
    assert not list(warnings(finished(**weak)))
    assert len(list(warnings(finished(has_prior=False)))) == 1
    warning, _ = warnings(finished(**weak, has_prior=False))
    assert "only 0.41 px between neighbouring keyframes (median, for 320x240)" in warning
    warning, _ = warnings(finished(**weak, has_prior=False, parallax=[0.1]))  # said once
    assert "hardly any parallax" in warning


def test_depths_that_change_with_the_views_are_warned_of():
    changing = {"has_two_depths": True, "has_prior": False}
    warning, _ = warnings(finished(**changing))
    assert "differ by 26% (median)" in warning
    warning, _ = warnings(finished(**changing, hardly_walked=True))  # said once
    assert "hardly did more than turn" in warning


def test_a_view_at_one_depth_needs_neither_focal_length_nor_unit():
    flat = finished(seeks_focal=True, has_prior=False, parallax=[0.1], knows_depth=False)
    (warning,) = warnings(flat)
    assert "at one depth" in warning


@pytest.mark.parametrize("broken", [{"lost": [3]}, {"failed": 3}])
def test_a_broken_run_gives_no_advice_about_the_focal_length(broken: dict):
    (warning,) = warnings(finished(focal_length=DOUBTFUL, **broken))
    assert "present focal length" not in warning


def test_a_broken_run_gives_no_advice_about_the_lens():
    bent = LensFit(300.0, (-0.1, 0.0), -0.07, 0.13)
    far = {"seeks_focal": True, "focal_is_free": True, "fx": 1500.0}
    (warning,) = warnings(finished(lens=bent, breaks=[Break(2, 2)], **far))
    assert "straight lines" not in warning and "degrees" not in warning


def test_an_unknown_focal_length_of_a_broken_run_gets_no_advice_from_its_halves():
    _, warning = warnings(finished(seeks_focal=True, focal_length=ZOOMED, lost=[3]))
    assert "the motion does not tell it: trajectory" in warning


@pytest.mark.parametrize("lost", [[3, 4], range(6), [18, 19]])
def test_a_film_is_not_called_cut_where_few_frames_are_lost_or_its_start(lost: Sequence[int]):
    (warning,) = warnings(finished(lost=lost))
    assert "cut" not in warning


def test_the_first_part_of_a_cut_film_is_named_if_a_later_one_was_kept():
    given_up = {"lost": range(8), "status": TrackingStatus.GIVEN_UP}
    (warning,) = warnings(finished(**given_up, worth=(True, 8)))
    assert warning.endswith("run the rest by itself: --start 10 --max-frames 8")
    for worth in ((False, 8), (True, 1)):  # a title that stands; a fade-in
        (warning,) = warnings(finished(**given_up, worth=worth))
        assert warning.endswith("; lost_frames.txt lists them")
    (warning,) = warnings(finished(lost=[3], worth=(True, 8)))  # the first part was repeated
    assert "cut" not in warning


def test_a_piece_that_is_to_be_run_anew_ends_where_many_frames_are_lost():
    lost, breaks = [2, *range(9, 14)], [Break(8, 8)]
    _, warning = warnings(finished(lost=lost, breaks=breaks, segments=[(0, 7), (9, 19)]))
    assert "here: --start 10 --max-frames 8, or --start 52 --max-frames 6. If" in warning
    lost = [*range(9, 12), 17]  # fewer in a row than a start needs divide nothing
    _, warning = warnings(finished(lost=lost, breaks=breaks, segments=[(0, 7), (8, 19)]))
    assert "here: --start 10 --max-frames 8, or --start 34 --max-frames 12. If" in warning


def test_guessed_depth_is_not_warned_of_where_much_is_measured_and_on_a_backdrop():
    assert not list(warnings(finished(unknown=0.7)))
    assert not list(warnings(finished(unknown=0.8, knows_depth=False)))


def test_a_run_that_measured_nothing_gets_no_advice_from_measurements():
    run = finished(seeks_focal=True, parallax=[])
    run.tracker.graph.adjustments = 0
    assert not list(warnings(run))


def test_a_lens_is_not_said_to_zoom_where_the_whole_run_fits_one():
    (warning,) = warnings(finished(seeks_focal=True, focal_length=DOUBTFUL))
    assert "but the flow fits --fx 598 best" in warning and "zoom" not in warning
