"""The map and its optimiser: rows stay together, moments live and die with them."""

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.splatting import GaussianMap, LearningRates, MapOptimizer, render
from tests.splatting.scenes import one_gaussian, random_map


def descend(optimizer: MapOptimizer, seed: int = 0) -> None:
    """Take one step along a fixed gradient."""
    for value in optimizer.gaussians.parameters.values():
        source = torch.Generator().manual_seed(seed)
        value.grad = torch.randn(value.shape, generator=source, dtype=value.dtype)
    optimizer.step()


# Known answers


def test_activations():
    gaussians = one_gaussian(scale=0.25, opacity=0.75)
    assert gaussians.scales.tolist() == [pytest.approx([0.25] * 3)]
    assert gaussians.opacities.tolist() == [pytest.approx(0.75)]


def test_first_step_has_the_length_of_the_rate():
    # Adam's first step is rate * sign(gradient).
    optimizer = MapOptimizer(one_gaussian(), LearningRates(means=0.125))
    before = optimizer.gaussians.means.detach().clone()
    optimizer.gaussians.means.grad = torch.tensor([[2.0, -5e-4, 7.0]], dtype=torch.float64)
    optimizer.step()
    step = (optimizer.gaussians.means.detach() - before)[0].tolist()
    assert step == pytest.approx([-0.125, 0.125, -0.125])


# Identities


def test_steps_equal_those_of_torch_adam():
    start = random_map("ordinary", 5, 0)
    optimizer = MapOptimizer(start, LearningRates())
    theirs = start.means.clone().requires_grad_()
    adam = torch.optim.Adam([theirs], lr=LearningRates().means, eps=MapOptimizer.EPSILON)
    for seed in range(20):
        descend(optimizer, seed)
        source = torch.Generator().manual_seed(seed)
        theirs.grad = torch.randn(theirs.shape, generator=source, dtype=theirs.dtype)
        adam.step()
    torch.testing.assert_close(optimizer.gaussians.means.detach(), theirs.detach())


def test_concatenate_and_prune_undo_each_other():
    first, second = random_map("ordinary", 4, 3), random_map("ordinary", 6, 4)
    both = first.concatenate(second)
    keep = torch.arange(10) < 4
    kept, expected = vars(both.keep(keep)), vars(first)
    assert all(torch.equal(kept[name], expected[name]) for name in expected)
    assert len(both.keep(~keep)) == 6


@pytest.mark.parametrize("order", ["append_then_prune", "prune_then_append"])
def test_moments_follow_their_rows(order: str):
    # Rows that survive must move exactly as if nothing had been added or pruned around them.
    start, new = random_map("ordinary", 6, 5), random_map("ordinary", 3, 6)
    optimizer, undisturbed = (MapOptimizer(start, LearningRates()) for _ in range(2))
    keep = torch.tensor([True, False, True, True, False, True])
    for _ in range(3):
        descend(optimizer), descend(undisturbed)
    if order == "append_then_prune":
        optimizer.append(new)
        optimizer.keep(torch.cat([keep, torch.ones(3, dtype=torch.bool)]))
    else:
        optimizer.keep(keep)
        optimizer.append(new)
    assert optimizer.gaussians.anchor_keyframe.tolist() == [0, 2, 3, 5, 0, 1, 2]
    for mine, other in ((optimizer, [4, 3]), (undisturbed, [6, 0])):
        gradient = torch.zeros(sum(other), 3, dtype=torch.float64)
        gradient[:] = 0.5
        mine.gaussians.means.grad = gradient
        mine.step()
    expected = undisturbed.gaussians.means.detach()[keep]
    torch.testing.assert_close(optimizer.gaussians.means.detach()[:4], expected)
    # The new rows take a full first step, whatever the age of the others.
    moved = optimizer.gaussians.means.detach()[4:] - new.means
    torch.testing.assert_close(moved, torch.full_like(moved, -LearningRates().means))


def test_replace_keeps_moments():
    optimizer = MapOptimizer(random_map("ordinary", 4, 7), LearningRates())
    for _ in range(5):
        descend(optimizer)
    optimizer.replace(random_map("ordinary", 4, 8))
    before = optimizer.gaussians.means.detach().clone()
    optimizer.gaussians.means.grad = torch.zeros(4, 3, dtype=torch.float64)
    optimizer.step()
    moved = (optimizer.gaussians.means.detach() - before).abs().max()
    assert moved > 0


# Degenerate input


def test_pruning_everything_and_starting_again():
    optimizer = MapOptimizer(random_map("ordinary", 3, 9), LearningRates())
    descend(optimizer)
    optimizer.keep(torch.zeros(3, dtype=torch.bool))
    assert len(optimizer.gaussians) == 0
    optimizer.step()
    optimizer.append(one_gaussian())
    camera = Camera(60.0, 60.0, 12.0, 9.0, 27, 21)
    render(optimizer.gaussians, camera, torch.eye(4)).color.sum().backward()
    optimizer.step()
    assert all(value.isfinite().all() for value in optimizer.gaussians.parameters.values())


# Errors


def test_errors_say_what_was_expected():
    gaussians = random_map("ordinary", 4, 10)
    with pytest.raises(InputError, match=r"quats_wxyz of shape \(4, 4\)"):
        GaussianMap(
            gaussians.means, gaussians.means, gaussians.log_scales, gaussians.opacity_logits,
            gaussians.colors, gaussians.anchor_keyframe,
        )  # fmt: skip
    with pytest.raises(AssertionError, match="float32"):
        gaussians.keep(torch.ones(4))
    with pytest.raises(AssertionError, match=r"\(1, 4\)"):
        MapOptimizer(gaussians, LearningRates()).replace(one_gaussian())


# Use


def test_descent_fits_an_image():
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    target = render(random_map("huge", 40, 11).detach(), camera, torch.eye(4)).color
    rates = LearningRates(means=1e-2, colors=2e-2, log_scales=2e-2)
    optimizer = MapOptimizer(random_map("huge", 60, 12), rates)
    errors = []
    for _ in range(80):
        color = render(optimizer.gaussians, camera, torch.eye(4)).color
        error = (color - target).square().mean()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.05 * errors[0]
