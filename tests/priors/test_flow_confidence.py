"""What the classical flow must not trust: borders, bare walls, disagreement, black images."""

import numpy as np
import pytest
import torch

from minislam.priors.dense_flow import grayscale
from minislam.priors.flow import STRIDE
from minislam.priors.grid_flow import as_matches, grid_matches, texture_confidence
from tests.priors.patterns import (
    HEIGHT,
    SIZE,
    WIDTH,
    constant,
    flow_of,
    on_grid,
    shifted,
    still,
    view,
)

NOTHING_LEFT = np.zeros((HEIGHT // 8, WIDTH // 8, 2), np.float32)

# Confidence


def test_what_leaves_the_image_has_no_confidence():
    flow = flow_of([shifted(0, 0, SIZE), shifted(30, 0, SIZE)])
    matches = flow.match([0], [1], still() + torch.tensor([[30.0], [0.0]]))
    outside = on_grid(matches.targets)[0, ..., 0] > WIDTH - 1
    assert outside[:, -3:].all()
    assert (on_grid(matches.confidences)[0][outside] == 0).all()
    assert on_grid(matches.confidences)[0, :, :9].mean() > 0.5


def test_the_border_of_the_image_counts_as_inside():
    texture = np.full((HEIGHT // 8, WIDTH // 8), 0.9)
    targets, confidence = grid_matches(
        constant(0, 0), NOTHING_LEFT, constant(0, 0), texture, STRIDE
    )
    assert targets[0, 0].tolist() == [0, 0] and (confidence == 0.9).all()
    _, left = grid_matches(constant(-0.5, 0), NOTHING_LEFT, constant(0.5, 0), texture, STRIDE)
    assert (left[:, 0] == 0).all() and (left[:, 1:] == 0.9).all()


def test_disagreement_costs_confidence_by_its_formula():
    texture = np.ones((HEIGHT // 8, WIDTH // 8))
    backward = constant(-2.0, 0.6)  # off by 0.6 px, the consistency scale
    _, confidence = grid_matches(constant(2.0, 0.0), NOTHING_LEFT, backward, texture, STRIDE)
    np.testing.assert_allclose(confidence[1:-1, 1:-1], np.exp(-0.5), rtol=1e-5)


def test_a_bare_wall_and_an_edge_have_no_confidence():
    wall = np.full(SIZE, 120, np.uint8)
    edge = wall.copy()
    edge[:, 64:] = 200  # vertical: a motion along it would go unnoticed
    corner = edge.copy()
    corner[48:] = 40
    assert (texture_confidence(wall, STRIDE) == 0).all()
    assert texture_confidence(edge, STRIDE).max() < 1e-3
    assert texture_confidence(corner, STRIDE)[6, 8] > 0.9
    assert texture_confidence(grayscale(shifted(0, 0, SIZE)), STRIDE).mean() > 0.7


def test_half_a_bare_wall_leaves_the_other_half():
    images = [shifted(d, 0, SIZE).clone() for d in (0, 3)]
    for image in images:
        image[:, :64] = 0.5
    matches = flow_of(images).match([0], [1], still())
    confidence = on_grid(matches.confidences)[0, ..., 0]
    assert confidence[:, :7].max() < 1e-3 and confidence[:, 10:14].mean() > 0.5


def test_matched_ratio_is_relative_to_what_texture_allows():
    texture = np.array([[0.5, 0.9], [0.0, 0.6]])
    confidence = 0.5 * texture
    targets = np.zeros((2, 2, 2))
    like = torch.zeros(0, dtype=torch.float64)
    matches = as_matches([targets, targets], [confidence, texture], [texture, texture], like)
    torch.testing.assert_close(matches.matched_ratios, torch.tensor([0.5, 1.0]).double())
    assert torch.equal(matches.confidences[:, 0], matches.confidences[:, 1])


# Degenerate input


def test_black_images_match_nothing():
    black, seen = torch.zeros(*SIZE, 3), shifted(0, 0, SIZE)
    matches = flow_of([black, seen, black]).match([0, 0], [1, 2], still(2))
    assert torch.isfinite(matches.targets).all()
    assert (matches.confidences == 0).all() and (matches.matched_ratios == 0).all()
    _, of_chain = flow_of([]).start_chain(black).advance(black)
    assert float(of_chain.matched_ratios) == 0


def test_unrelated_images_hardly_match():
    other = view(np.eye(2), np.array([5000.0, 3000.0]), SIZE)
    matches = flow_of([shifted(0, 0, SIZE), other]).match([0, 0], [0, 1], still(2))
    assert matches.matched_ratios[1] < 0.15 < 0.9 < matches.matched_ratios[0]


@pytest.mark.parametrize("brightness", [0.0, 0.5, 1.0])
def test_a_view_that_goes_blank_is_not_matched(brightness: float):
    blank, seen = torch.full((*SIZE, 3), brightness), shifted(0, 0, SIZE)
    assert flow_of([seen, blank]).match([0], [1], still()).matched_ratios[0] < 0.01
    _, of_chain = flow_of([]).start_chain(seen).advance(blank)
    assert float(of_chain.matched_ratios) < 0.01


def test_exposure_does_not_matter():
    darker = 0.2 + 0.5 * shifted(3, 0, SIZE)
    plain, dimmed = (
        flow_of([shifted(0, 0, SIZE), image]).match([0], [1], still()).matched_ratios[0]
        for image in (shifted(3, 0, SIZE), darker)
    )
    assert dimmed > 0.9 * plain
