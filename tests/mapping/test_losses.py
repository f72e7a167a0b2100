import pytest
import torch

from minislam.mapping import MappingConfig
from minislam.mapping.losses import (
    color_loss,
    isotropic_loss,
    metre,
    render_loss,
    ssim_loss,
    weighted_depth_loss,
)
from minislam.splatting import GaussianMap, Rendering
from tests.helpers import assert_gradients_close, generator, numerical_gradient


def random_image(seed: int, height: int = 13, width: int = 15) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=generator(seed), dtype=torch.float64)


# Known answers


def test_ssim_of_two_constant_images_by_hand():
    # Away from the border both variances vanish: SSIM = (2 a b + C1) / (a^2 + b^2 + C1).
    first, second = torch.full((31, 31, 3), 0.2), torch.full((31, 31, 3), 0.6)
    expected = 1 - (2 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert float(ssim_loss(first, second)[15, 15]) == pytest.approx(expected, abs=1e-4)


def test_color_loss_mixes_l1_and_ssim_and_skips_black_pixels():
    image, rendered = random_image(0), random_image(1)
    image[0, 0] = 0
    loss = color_loss(rendered, image, 0.2)
    expected = 0.8 * (rendered - image).abs().mean(-1) + 0.2 * ssim_loss(rendered, image)
    assert loss[0, 0] == 0
    torch.testing.assert_close(loss[1:], expected[1:])


def test_depth_loss_ignores_beta_only_for_floaters():
    #                          near  floater unknown far  hole
    reference = torch.tensor([[4.0, 4.0, 0.0, 40.0, 4.0]])
    rendered = torch.tensor([[3.5, 1.0, 3.0, 3.0, 0.5]])
    opacity = torch.tensor([[1.0, 0.95, 1.0, 1.0, 0.2]])
    weight = torch.tensor([[0.1, 0.1, 1.0, 1.0, 0.0]])
    loss = weighted_depth_loss(rendered, opacity, reference, weight, 20.0, 1.0)
    torch.testing.assert_close(loss, torch.tensor([[0.05, 3.0, 0.0, 0.0, 0.0]]))


def test_isotropic_loss_by_hand():
    # Mean 2: distances 1, 0, 1; a ball costs nothing.
    scales = torch.tensor([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])
    assert float(isotropic_loss(scales)) == pytest.approx(2 / 6)


def one_gaussian() -> GaussianMap:
    return GaussianMap(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.zeros(1, 3),
        torch.zeros(1),
        torch.zeros(1, 3),
        torch.zeros(1, dtype=torch.int64),
    )


def rendering_of(color: torch.Tensor, depth: torch.Tensor) -> Rendering:
    return Rendering(color, depth, torch.ones_like(depth), torch.ones(1))


# Identities


def test_ssim_loss_of_equal_images_is_zero():
    image = random_image(2)
    assert float(ssim_loss(image, image).abs().max()) < 1e-12


def test_pixels_of_weight_zero_do_not_pull_at_the_rendering_at_all():
    # The SSIM part too is weighted per pixel: beyond its window nothing reaches the mover.
    image, reference = random_image(3, 40, 40), torch.full((40, 40), 2.0, dtype=torch.float64)
    weight = torch.ones(40, 40, dtype=torch.float64)
    weight[:, 20:] = 0
    color = random_image(4, 40, 40).requires_grad_()
    depth = torch.full((40, 40), 1.9, dtype=torch.float64).requires_grad_()
    loss, _ = render_loss(
        one_gaussian(), rendering_of(color, depth), image, reference, weight, 2.0, MappingConfig()
    )
    loss.backward()
    assert color.grad[:, 26:].abs().max() == 0 and depth.grad[:, 20:].abs().max() == 0
    assert (color.grad[:, :20].abs() > 0).float().mean() > 0.99


def test_world_units_do_not_change_the_loss():
    image, color = random_image(5), random_image(6)
    depth, reference = random_image(7)[..., 0] + 2, random_image(8)[..., 0] + 2
    weight, config = torch.ones(13, 15, dtype=torch.float64), MappingConfig()
    losses = []
    for unit in [1.0, 250.0]:
        rendering = rendering_of(color, depth * unit)
        loss, _ = render_loss(
            one_gaussian(), rendering, image, reference * unit, weight, 2.5 * unit, config
        )
        losses.append(float(loss))
    assert losses[0] == pytest.approx(losses[1], rel=1e-9)


# Gradients


def test_color_loss_gradient_agrees_with_finite_differences():
    image, rendered = random_image(9, 6, 7), random_image(10, 6, 7)
    weight = random_image(11, 6, 7)[..., 0]
    leaf = rendered.clone().requires_grad_()
    (weight * color_loss(leaf, image, 0.2)).sum().backward()
    expected = numerical_gradient(lambda x: (weight * color_loss(x, image, 0.2)).sum(), rendered)
    assert_gradients_close(leaf.grad, expected, relative=1e-6)


def test_ssim_gradient_agrees_with_autograd_through_its_definition():
    image, rendered = random_image(22, 40, 37), random_image(23, 40, 37)  # wider than a strip
    weight = random_image(24, 40, 37)[..., 0]
    leaf, twin = (rendered.clone().requires_grad_() for _ in range(2))
    loss = ssim_loss(leaf, image)
    (weight * loss).sum().backward()

    def local_mean(channels: torch.Tensor) -> torch.Tensor:
        window = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=torch.float64) / 1.5) ** 2)
        window = window[:, None] * window / window.sum() ** 2
        return torch.nn.functional.conv2d(channels[:, None], window[None, None], padding=5)[:, 0]

    x, y = twin.permute(2, 0, 1), image.permute(2, 0, 1)
    m_x, m_y, m_xx, m_xy, m_yy = (local_mean(c) for c in (x, y, x * x, x * y, y * y))
    above = (2 * m_x * m_y + 1e-4) * (2 * (m_xy - m_x * m_y) + 9e-4)
    below = (m_x**2 + m_y**2 + 1e-4) * (m_xx - m_x**2 + m_yy - m_y**2 + 9e-4)
    expected = (1 - above / below).mean(0)
    (weight * expected).sum().backward()
    torch.testing.assert_close(loss, expected)
    assert_gradients_close(leaf.grad, twin.grad, relative=1e-9)


def test_isotropic_gradient_agrees_with_finite_differences():
    scales = random_image(12, 4, 1)[:, 0]
    leaf = scales.clone().requires_grad_()
    isotropic_loss(leaf).backward()
    assert_gradients_close(leaf.grad, numerical_gradient(isotropic_loss, scales), relative=1e-6)


def test_depth_gradient_agrees_with_finite_differences_floaters_included():
    reference, opacity = 2 + random_image(13, 5, 6)[..., 0], random_image(14, 5, 6)[..., 0]
    weight = random_image(15, 5, 6)[..., 0]
    rendered = 1 + 2.5 * random_image(16, 5, 6)[..., 0]  # on both sides of the reference

    def loss(value: torch.Tensor) -> torch.Tensor:
        return weighted_depth_loss(value, opacity, reference, weight, 20.0, 0.5).sum()

    leaf = rendered.clone().requires_grad_()
    loss(leaf).backward()
    assert_gradients_close(leaf.grad, numerical_gradient(loss, rendered), relative=1e-6)


def test_the_whole_render_loss_has_the_weighted_gradients_of_its_parts():
    image, color = random_image(17, 6, 7), random_image(18, 6, 7)
    depth, reference = random_image(19, 6, 7)[..., 0] + 2, random_image(20, 6, 7)[..., 0] + 2
    weight, config = random_image(21, 6, 7)[..., 0], MappingConfig()

    def loss(color: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        rendering = rendering_of(color, depth)
        return render_loss(one_gaussian(), rendering, image, reference, weight, 2.5, config)[0]

    leaves = color.clone().requires_grad_(), depth.clone().requires_grad_()
    loss(*leaves).backward()
    expected = numerical_gradient(lambda value: loss(value, depth), color)
    assert_gradients_close(leaves[0].grad, expected, relative=1e-6)
    expected = numerical_gradient(lambda value: loss(color, value), depth)
    assert_gradients_close(leaves[1].grad, expected, relative=1e-6)
    # lambda_5 : lambda_6 = alpha : 1 - alpha, over all pixels; depth in metres of the constants.
    outer = weight * torch.sign(depth - reference) / depth.numel() / metre(2.5)
    torch.testing.assert_close(leaves[1].grad, (1 - config.color_weight) * outer)


# Degenerate input


def test_black_images_and_unknown_depth_give_zero_and_finite_gradients():
    black = torch.zeros(12, 12, 3)
    color = torch.zeros(12, 12, 3, requires_grad=True)
    depth = torch.zeros(12, 12, requires_grad=True)
    weight = torch.ones(12, 12)
    loss, _ = render_loss(
        one_gaussian(),
        rendering_of(color, depth),
        black,
        torch.zeros(12, 12),
        weight,
        1.0,
        MappingConfig(),
    )
    loss.backward()
    assert loss == 0 and torch.isfinite(color.grad).all()


def test_long_gaussians_weigh_the_same_in_any_world_unit():
    black, nothing, losses = torch.zeros(13, 15, 3), torch.zeros(13, 15), []
    for unit in (1.0, 250.0):
        gaussians = one_gaussian()
        gaussians.log_scales[:] = (unit * torch.tensor([0.1, 0.2, 0.9])).log()
        given = gaussians, rendering_of(black, nothing), black, nothing, nothing
        losses.append(float(render_loss(*given, 2.5 * unit, MappingConfig())[0]))
    assert 0 < losses[0] == pytest.approx(losses[1], rel=1e-5)
