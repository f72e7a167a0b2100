import pytest
import torch
from scipy import ndimage

from minislam.uncertainty import UncertaintyConfig
from minislam.uncertainty.losses import (
    STRUCTURE_CAP,
    cell_loss,
    depth_loss,
    median_filter,
    modified_ssim_loss,
    ssim_components,
    variance_regulariser,
)
from tests.helpers import assert_gradients_close, generator, numerical_gradient

CONFIG = UncertaintyConfig()


def random_image(seed: int, height: int = 20, width: int = 24) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=generator(seed), dtype=torch.float64)


# Known answers


def test_equal_images_give_exactly_zero():
    image = random_image(1).float()
    loss = modified_ssim_loss(image, image, torch.ones(20, 24), CONFIG)
    assert torch.equal(loss, torch.zeros(20, 24))


def test_a_shift_of_brightness_leaves_contrast_and_structure_at_their_caps():
    image = 0.4 * random_image(2)
    opacity = torch.full((20, 24), 0.7, dtype=torch.float64)
    loss = modified_ssim_loss(image, image + 0.3, opacity, CONFIG)
    luminance, contrast, structure = ssim_components(image, image + 0.3)
    inner = (slice(3, -3), slice(3, -3))  # zero padding breaks the identity at the border
    assert (contrast[inner] == STRUCTURE_CAP).all() and (structure[inner] == STRUCTURE_CAP).all()
    # (1 - 0.98)^2 = 0.0004.
    expected = 668.42 * 0.0004 * 0.7 * (1 - luminance)
    torch.testing.assert_close(loss[inner], expected[inner])


def test_depth_loss_counts_only_known_and_near_pixels():
    reference = torch.tensor([[2.0, 0.0, 50.0]])
    rendered = torch.tensor([[3.5, 3.0, 3.0]])
    expected = torch.tensor([[1.5, 0.0, 0.0]])
    assert torch.equal(depth_loss(rendered, reference, 10.0), expected)


def test_cell_loss_is_smallest_at_twice_the_root_of_the_error():
    beta = torch.linspace(0.15, 6, 20000, dtype=torch.float64)
    for error, best in [(0.0625, 0.5), (0.5, 1.4142), (5.0, 4.4721)]:
        loss = cell_loss(beta[None], torch.full_like(beta[None], error), beta[None] + 9, CONFIG)
        assert float(beta[loss[0].argmin()]) + 1e-3 == pytest.approx(best, abs=1e-3)


def test_cells_that_show_no_surface_teach_nothing():
    beta = torch.ones(1, 2, requires_grad=True)
    cell_loss(beta, torch.ones(1, 2), torch.tensor([[0.89, 0.91]]), CONFIG).sum().backward()
    assert beta.grad[0, 0] == 0 and beta.grad[0, 1] != 0


def test_variance_of_two_groups_by_hand():
    features = torch.tensor([[1.0, 0.0], [1.0, 0.1], [0.0, 1.0]])
    # The first two are similar: mean 2, variance 1 in both rows; the third stands alone.
    beta = torch.tensor([1.0, 3.0, 9.0])
    torch.testing.assert_close(
        variance_regulariser(beta, features, CONFIG), torch.tensor(2.0 / 3.0)
    )


def test_a_cell_is_similar_to_itself_whatever_the_least_similarity():
    features = torch.randn(5, 3, generator=generator(12))
    strict = UncertaintyConfig(similarity=1.0)
    assert variance_regulariser(torch.arange(5.0), features, strict) == 0


def test_only_the_128_most_similar_cells_enter_the_variance():
    # All are similar, cosine > 0.87, but each more to some than to others.
    angle = 0.5 * torch.rand(200, generator=generator(10), dtype=torch.float64)  # radian
    features = torch.stack([angle.cos(), angle.sin()], -1)
    beta = torch.rand(200, generator=generator(11), dtype=torch.float64)
    similarity = features @ features.T
    expected = torch.stack([beta[row.topk(128).indices].var(correction=0) for row in similarity])
    torch.testing.assert_close(variance_regulariser(beta, features, CONFIG), expected.mean())


# Identities


def test_median_filter_agrees_with_scipy_and_removes_a_thin_line():
    values = torch.rand(9, 11, generator=generator(3))
    expected = ndimage.median_filter(values.numpy(), 5, mode="mirror")
    assert torch.equal(median_filter(values, 5), torch.from_numpy(expected))
    line = torch.zeros(9, 11)
    line[:, 4] = 5
    assert median_filter(line, 3).max() == 0


def test_constant_beta_has_no_variance_whatever_the_features():
    features = torch.randn(300, 8, generator=generator(4))
    loss = variance_regulariser(torch.full((300,), 0.7), features, CONFIG)
    assert float(loss) == pytest.approx(0, abs=1e-10)


def test_dissimilar_features_do_not_tie_their_beta():
    features = torch.eye(6)
    beta = torch.arange(6.0)
    assert variance_regulariser(beta, features, CONFIG) == 0


# Gradients


def test_cell_loss_and_variance_gradients_agree_with_finite_differences():
    beta = 0.2 + torch.rand(4, 5, generator=generator(5), dtype=torch.float64)
    error = torch.rand(4, 5, generator=generator(6), dtype=torch.float64)
    features = torch.randn(20, 3, generator=generator(7), dtype=torch.float64)

    def loss(value):
        cells = cell_loss(value, error, torch.ones_like(error), CONFIG).mean()
        return cells + variance_regulariser(value.reshape(-1), features, CONFIG)

    leaf = beta.clone().requires_grad_()
    loss(leaf).backward()
    assert_gradients_close(leaf.grad, numerical_gradient(loss, beta), relative=1e-6)


def test_beta_under_the_floor_is_moved_only_by_its_similar_cells():
    beta = torch.tensor([[0.05]], requires_grad=True)
    cell_loss(beta, torch.ones(1, 1), torch.ones(1, 1), CONFIG).sum().backward()
    assert beta.grad[0, 0] == 0
    pair = torch.tensor([0.05, 0.5], requires_grad=True)
    variance_regulariser(pair, torch.ones(2, 3), CONFIG).backward()
    assert pair.grad[0] < 0


# Degenerate input


def test_black_and_constant_images_give_finite_losses():
    black, grey = torch.zeros(8, 9, 3), torch.full((8, 9, 3), 0.5)
    for first, second in [(black, black), (black, grey), (grey, grey)]:
        loss = modified_ssim_loss(first, second, torch.ones(8, 9), CONFIG)
        assert torch.isfinite(loss).all() and (loss >= 0).all() and (loss <= 5).all()


def test_zero_features_and_a_single_cell_are_finite():
    assert variance_regulariser(torch.tensor([0.5]), torch.zeros(1, 4), CONFIG) == 0
    beta = torch.rand(5, generator=generator(9))
    assert torch.isfinite(variance_regulariser(beta, torch.zeros(5, 4), CONFIG))


def test_median_window_shrinks_on_a_grid_smaller_than_itself():
    assert median_filter(torch.rand(2, 2, generator=generator(8)), 5).shape == (2, 2)
