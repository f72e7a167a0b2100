import pytest
import torch

from minislam.geometry import Camera
from minislam.uncertainty.weights import (
    BETA_CUT,
    DATA_RATE,
    MAPPING_CUT,
    UNIT_BETA,
    beta_of_mask,
    clipped_beta,
    mapping_weight,
    pixel_weight,
    relative_weight,
    tracking_weight,
    weight_of,
)

CAMERA = Camera(20.0, 20.0, 15.5, 11.5, 32, 24)


def grid(value: float) -> torch.Tensor:
    return torch.full((3, 4), value, dtype=torch.float64)


# Known answers


def test_the_rate_is_that_of_the_official_schedule():
    assert pytest.approx(1.6315789, abs=1e-7) == DATA_RATE


@pytest.mark.parametrize(
    ("beta_raw", "mapping", "tracking"),
    [
        (0.05, 5.0, 1.0),
        (0.24, 4.596, 1.0),
        (0.3, 2.73, 1.0),
        (0.5, 0.879, 0.879),
        (0.693, 0.437, 0.437),
        (1.0, 0.203, 0.203),
        (1.40, 0.101, 0.101),
        (1.42, 0.0, 0.098),
        (2.0, 0.0, 0.049),
        (4.47, 0.0, 0.010),
    ],
)
def test_weight_table(beta_raw, mapping, tracking):
    assert float(mapping_weight(grid(beta_raw), CAMERA)[5, 7]) == pytest.approx(mapping, rel=6e-3)
    weight = float(tracking_weight(grid(beta_raw), CAMERA, 8)[1, 2])
    assert weight == pytest.approx(tracking, abs=5e-4)


def test_the_largest_weight_is_that_of_an_adjusted_beta_of_0_1016():
    assert float(pixel_weight(grid(0.02), CAMERA).max()) == pytest.approx(
        0.5 / 0.101632**2, rel=1e-5
    )


def test_thresholds_of_the_weights_one_and_zero():
    assert float(tracking_weight(grid(0.4711), CAMERA, 8).min()) == pytest.approx(1, abs=1e-3)
    assert float(tracking_weight(grid(0.475), CAMERA, 8).max()) < 1
    assert float(mapping_weight(grid(1.4079), CAMERA).min()) > 0
    assert float(mapping_weight(grid(1.4083), CAMERA).max()) == 0
    assert pytest.approx(1.408, abs=5e-3) == BETA_CUT


def test_a_given_mask_gives_the_full_weight_or_almost_none():
    moving = torch.zeros(24, 32, dtype=torch.bool)
    moving[:, 8:16] = True
    beta = beta_of_mask(moving)
    assert torch.equal(mapping_weight(beta, CAMERA) == 0, moving)
    assert float(mapping_weight(beta, CAMERA).max()) == 5
    weight = tracking_weight(beta, CAMERA, 8)
    assert (weight[:, [0, 2, 3]] == 1).all() and (weight[:, 1] < 0.02).all()


def test_the_most_static_tenth_of_a_frame_counts_fully_and_the_others_relative_to_it():
    weight = torch.linspace(0.001, 0.2, 200).reshape(10, 20)  # a beta that is large everywhere
    relative = relative_weight(weight)
    assert int((relative == 1).sum()) == 20
    assert float(relative[0, 0]) == pytest.approx(0.001 / 0.18, rel=0.01)
    assert torch.equal(relative_weight(torch.full((3, 4), 0.03)), torch.ones(3, 4))


# Identities


def test_relative_weights_do_not_depend_on_the_level_and_leave_a_well_explained_frame_alone():
    weight = torch.rand(6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(relative_weight(0.01 * weight), relative_weight(weight))
    weight[:2] = 1  # a quarter of the cells
    assert torch.equal(relative_weight(weight), weight)


def test_tracking_weight_is_sampled_at_the_pixels_of_the_camera_grid():
    beta = torch.linspace(0.3, 2.0, 12).reshape(3, 4)
    weight = tracking_weight(beta, CAMERA, 5)
    pixels = CAMERA.pixel_grid(5).long()
    full = pixel_weight(beta, CAMERA).clamp_max(1)
    assert torch.equal(weight, full[pixels[..., 1], pixels[..., 0]])


# Gradients


def test_no_gradient_flows_through_a_weight_but_it_does_through_the_loss_beta():
    beta = grid(0.5).requires_grad_()
    assert not mapping_weight(beta, CAMERA).requires_grad
    assert not tracking_weight(beta, CAMERA, 8).requires_grad
    clipped_beta(beta).sum().backward()
    assert torch.equal(beta.grad, torch.ones_like(beta))


def test_the_betas_of_the_weights_one_and_of_the_cut_have_these_weights():
    for beta, weight in ((BETA_CUT, MAPPING_CUT), (UNIT_BETA, 1.0)):
        assert float(weight_of(clipped_beta(grid(beta))).max()) == pytest.approx(weight, rel=1e-9)
