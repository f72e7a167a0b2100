"""The first depth without a prior, on matches of a known room: exact at first, then spoilt."""

import pytest
import torch
from torch import Tensor

from minislam.priors.interfaces import FlowMatches
from minislam.tracking.safeguards.first_depth import essential_disparities, triangulate
from tests.tracking.matches import (
    CELLS,
    GRID,
    flat,
    matches_to,
    room_disparities,
    seen_matches,
    sideways,
)
from tests.tracking.scene import normal, uniform


def triangulated(T_target_source: Tensor, matches: FlowMatches) -> Tensor:
    targets, confidences = flat(matches)
    return triangulate(GRID, T_target_source, targets, confidences[:, 0] > 0.5)


# Known answers


def test_triangulation_by_hand():
    # Sideways by 0.5 at fx = 60 px: a cell that moves 12 px has disparity 0.4, 24 px: 0.8.
    flow = torch.where(torch.arange(CELLS) % 3 == 0, 24.0, 12.0)
    targets = GRID.pixels - torch.stack([flow, torch.zeros(CELLS)], 1)
    transform = torch.eye(4, dtype=torch.float64)
    transform[0, 3] = -0.5
    disparities = triangulated(transform, matches_to(targets))
    expected = torch.where(flow == 24.0, 2.0, 1.0)  # in units of the median
    torch.testing.assert_close(disparities, expected, rtol=1e-5, atol=0)


def test_triangulation_recovers_a_room_up_to_scale():
    truth = room_disparities()
    for scale in (1.0, 7.0):
        transform = sideways()
        matches = seen_matches(transform, truth)
        transform[:3, 3] *= scale  # the length of the step cannot be seen, nor does it matter
        recovered = triangulated(transform, matches)
        torch.testing.assert_close(recovered, truth / truth.median(), rtol=2e-3, atol=0)


def test_triangulation_gives_doubtful_cells_the_median():
    truth, transform = room_disparities(), sideways()
    matches = seen_matches(transform, truth)
    targets, confidence = matches.targets[0].T.clone(), torch.ones(CELLS)
    confidence[3] = 0.2
    targets[5] = 2 * GRID.pixels[5] - targets[5]  # the wrong way: a point behind both cameras
    targets[7] += 40 * (targets[7] - GRID.pixels[7])  # forty times too near
    recovered = triangulated(transform, matches_to(targets, confidence))
    assert (recovered[[3, 5, 7]] == 1).all()
    others = torch.ones(CELLS, dtype=torch.bool)
    others[[3, 5, 7]] = False
    ratio = recovered[others] / truth[others]
    assert ratio.max() / ratio.min() < 1.01


def test_the_essential_matrix_gives_the_room_without_a_pose():
    truth = room_disparities()
    # RANSAC accepts 0.7 px: with little parallax a wrong matrix would explain the matches as well.
    disparities = essential_disparities(GRID, *flat(seen_matches(sideways(0.6), truth)))
    assert disparities is not None
    ratio = disparities / (truth / truth.median())
    assert ratio.median() == pytest.approx(1, abs=0.02)
    assert (ratio - 1).abs().median() < 0.02


def test_the_essential_matrix_survives_outliers_and_repeats_itself():
    truth = room_disparities()
    targets = seen_matches(sideways(0.5), truth).targets[0].T
    is_outlier = (uniform(3, CELLS, 1) < 0.2).expand(CELLS, 2)
    spoilt = torch.where(is_outlier, targets + 15 * normal(4, CELLS, 2).float(), targets)
    first = essential_disparities(GRID, *flat(matches_to(spoilt)))
    assert torch.equal(first, essential_disparities(GRID, *flat(matches_to(spoilt))))
    good = ~is_outlier[:, 0]
    ratio = first[good] / (truth / truth.median())[good]
    assert (ratio / ratio.median() - 1).abs().median() < 0.05


def test_matches_that_stand_still_give_finite_disparities():
    standing = matches_to(GRID.pixels)
    disparities = essential_disparities(GRID, *flat(standing))
    assert disparities is None or bool(torch.isfinite(disparities).all())
    assert torch.isfinite(triangulated(torch.eye(4), standing)).all()


def test_without_confident_matches_there_is_no_matrix_and_every_cell_is_as_far():
    blind = matches_to(GRID.pixels, 0.1)
    assert essential_disparities(GRID, *flat(blind)) is None
    assert torch.equal(triangulated(sideways(), blind), torch.ones(CELLS))
