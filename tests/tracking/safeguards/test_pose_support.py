"""Doubtful poses start again from their neighbours; without support a frame is lost."""

import pytest
import torch

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.safeguards.pose_support import PoseFit, judged_by_pose, retry_doubtful
from tests.tracking.wall import GRID, true_graph


def place(index: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = index
    return pose


def fit(index: float, support: float) -> PoseFit:
    return PoseFit(place(index), support)


def from_near_enough(index: int, start: torch.Tensor) -> PoseFit:
    """Find the pose of a frame from a start at most one frame away."""
    return fit(index, 0.3) if abs(float(start[0, 3]) - index) < 1.5 else fit(0, 0.0)


def fits_with(wrong: dict[int, float]) -> dict[int, PoseFit]:
    """Return good fits of ten frames, but frames with a given support stand far away."""
    return {k: fit(-50, wrong[k]) if k in wrong else fit(k, 0.3) for k in range(10)}


def test_a_gap_is_closed_from_its_start():
    fits = fits_with({4: 0.02, 5: 0.01, 6: 0.0})
    assert retry_doubtful(fits, list(range(1, 9)), from_near_enough) == []
    assert [float(fits[k].T_camera_world[0, 3]) for k in range(10)] == list(range(10))


def test_a_gap_is_closed_from_its_end_too():
    def only_backwards(index: int, start: torch.Tensor) -> PoseFit:
        return fit(index, 0.3) if float(start[0, 3]) > index else fit(0, 0.0)

    fits = fits_with({4: 0.02, 5: 0.01})
    assert retry_doubtful(fits, list(range(1, 9)), only_backwards) == []
    assert [float(fits[k].T_camera_world[0, 3]) for k in (4, 5)] == [4, 5]


def test_a_frame_that_nothing_supports_is_lost():
    fits = fits_with({4: 0.02})
    assert retry_doubtful(fits, list(range(1, 9)), lambda k, start: fit(k, 0.01)) == [4]
    assert 4 not in fits and len(fits) == 9


def test_a_worse_second_start_changes_nothing():
    fits = fits_with({4: 0.1})
    assert retry_doubtful(fits, list(range(1, 9)), lambda k, start: fit(k, 0.05)) == []
    assert float(fits[4].T_camera_world[0, 3]) == -50


def test_supported_frames_are_not_tried_again():
    assert retry_doubtful(fits_with({4: 0.2}), list(range(1, 9)), None) == []
    assert retry_doubtful({0: fit(0, 1.0)}, [], None) == []


@pytest.mark.parametrize(("ratio", "matched"), [(0.9, 1.0), (1.1, 1 / 3)])
def test_what_a_pose_explains_is_said_in_px_of_a_reference_image(
    monkeypatch: pytest.MonkeyPatch, ratio: float, matched: float
):
    graph, targets = true_graph([0, 1]), GRID.pixels.T[None].clone()
    monkeypatch.setattr(graph, "start_pose", lambda *_: graph.keyframes.T_camera_world[-1])
    # The pose predicts no flow; every second cell flows 4 px, of which a quarter is free.
    targets[:, 0, ::2] += ratio * 4 * graph.pixel_scale
    matches = FlowMatches(targets, torch.ones_like(targets), torch.zeros(1))
    assert float(judged_by_pose(graph, matches).matched_ratios) == pytest.approx(matched)
