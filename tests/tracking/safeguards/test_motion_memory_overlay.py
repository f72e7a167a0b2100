"""Cells that stand still while the rest of the image moves: a logo is found, a scene is not."""

import pytest
import torch
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.safeguards.motion_memory import overlay_weights, without_overlay
from tests.tracking.wall import GRID

HEIGHT, WIDTH = GRID.shape
LOGO = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
LOGO[1:3, 2:5] = True
BESIDE = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
BESIDE[0:5, 0:7] = True  # two cells on each side, as far as there are any


def flow(still: Tensor, way: float = 9.0, confidence: float = 0.9) -> FlowMatches:
    """Return the flow of an image that moves by `way` px, but for cells (h, w) that stand."""
    targets = GRID.pixels.T[None].clone()
    targets[:, 0] += way * ~still.reshape(-1)
    confidences = torch.full_like(targets, 0.9)
    confidences[..., still.reshape(-1)] = confidence
    return FlowMatches(targets, confidences, torch.ones(1))


def test_a_logo_and_the_cells_beside_it_count_no_longer():
    weights = overlay_weights([flow(LOGO)] * 3, GRID)
    assert weights is not None
    assert torch.equal(weights.reshape(HEIGHT, WIDTH) == 0, BESIDE)
    assert set(weights.tolist()) == {0.0, 1.0}


def test_an_overlay_counts_in_no_match():
    matches, overlay = flow(LOGO), 1 - LOGO.reshape(-1).float()
    seen = without_overlay(matches, overlay)
    assert torch.equal(seen.confidences > 0, (overlay > 0).expand_as(seen.confidences))
    assert torch.equal(seen.targets, matches.targets)
    assert seen.matched_ratios.tolist() == pytest.approx([1.0])
    assert without_overlay(matches, None) is matches


def test_an_overlay_alone_is_no_match():
    lost, overlay = flow(LOGO), 1 - LOGO.reshape(-1).float()
    lost.confidences[..., overlay > 0] = 0
    lost.matched_ratios[:] = 0.2
    assert float(without_overlay(lost, overlay).matched_ratios) == 0


def test_most_of_the_time_is_enough():
    five = [flow(LOGO)] * 4 + [flow(torch.zeros_like(LOGO))]
    assert overlay_weights(five, GRID) is not None
    assert overlay_weights(five[2:], GRID) is None


@pytest.mark.parametrize(
    "flows",
    [
        [flow(torch.zeros_like(LOGO))] * 5,  # a scene in which all moves
        [flow(LOGO)],  # too short to tell
        [flow(LOGO, way=2.0)] * 5,  # the camera hardly moves
        [flow(LOGO, confidence=0.1)] * 5,  # black bars match nothing
        [flow(LOGO.roll(6 * k, 1)) for k in range(5)],  # where the camera heads for
        [flow(LOGO & (torch.arange(WIDTH) < 3))] * 5,  # two cells
        [],
    ],
)
def test_a_scene_has_no_overlay(flows: list[FlowMatches]):
    assert overlay_weights(flows, GRID) is None
