"""The fast renderer against its readable twin, in values and in every gradient."""

import pytest
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting import GaussianMap, Rendering, render, render_reference
from tests.helpers import assert_gradients_close, generator, numerical_gradient
from tests.splatting.scenes import (
    KINDS,
    converted,
    one_gaussian,
    random_camera,
    random_map,
    random_pose,
)

pytestmark = pytest.mark.slow

SCENES_PER_KIND = 25  # times eight kinds: 200 scenes


def loss_of(rendering: Rendering, seed: int) -> Tensor:
    """Return a random linear functional of colour, depth and opacity."""
    source = generator(seed)
    total = torch.zeros((), dtype=rendering.color.dtype)
    for image in rendering[:3]:
        total = total + (image * torch.randn(image.shape, generator=source).to(image)).sum()
    return total


def with_leaves(gaussians: GaussianMap) -> GaussianMap:
    leaves = [value.clone().requires_grad_() for value in gaussians.parameters.values()]
    return GaussianMap(*leaves, gaussians.anchor_keyframe)


def gradients(renderer, gaussians, camera, pose, twist, seed) -> tuple[Rendering, list[Tensor]]:
    """Render with everything that can carry a gradient; return the image and all gradients."""
    background = torch.rand(3, generator=generator(seed), dtype=torch.float64)
    gaussians = with_leaves(gaussians)
    twist = twist.clone().requires_grad_()
    offsets = torch.zeros_like(gaussians.means[:, :2]).requires_grad_()
    rendering = renderer(gaussians, camera, pose, background, twist, offsets)
    leaves = [*gaussians.parameters.values(), twist, offsets]
    return rendering, list(torch.autograd.grad(loss_of(rendering, seed), leaves))


# Identities


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_gradients_equal_those_of_the_twin(kind: str):
    nonzero = 0
    for seed in range(SCENES_PER_KIND):
        gaussians, camera, pose = random_map(kind, 24, seed), random_camera(seed), random_pose(seed)
        twist = torch.zeros(6, dtype=torch.float64)
        if seed % 5 == 0:
            twist = 0.1 * torch.randn(6, generator=generator(seed), dtype=torch.float64)
        ours, our_gradients = gradients(render, gaussians, camera, pose, twist, seed)
        twin, twin_gradients = gradients(render_reference, gaussians, camera, pose, twist, seed)
        for one, other in zip(ours, twin, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)
        for one, other in zip(our_gradients, twin_gradients, strict=True):
            assert_gradients_close(one, other, relative=1e-10, absolute=1e-11)
            nonzero += int(one.abs().max() > 1e-6)
    # Seven gradients per scene; some scenes show nothing, most must show something.
    assert nonzero > 0.5 * 7 * SCENES_PER_KIND


def test_image_is_the_same_with_and_without_gradients():
    gaussians, camera, pose = random_map("ordinary", 30, 1), random_camera(1), random_pose(1)
    plain = render(gaussians, camera, pose)
    assert not plain.color.requires_grad
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    graph = render(with_leaves(gaussians), camera, pose, None, twist)
    for one, other in zip(plain, graph, strict=True):
        assert torch.equal(one, other)


def test_two_runs_give_the_same_bytes():
    gaussians, camera, pose = random_map("crowded", 60, 2), random_camera(2), random_pose(2)
    twist = torch.zeros(6, dtype=torch.float64)
    first = gradients(render, gaussians, camera, pose, twist, 0)
    second = gradients(render, gaussians, camera, pose, twist, 0)
    for one, other in zip([*first[0], *first[1]], [*second[0], *second[1]], strict=True):
        assert torch.equal(one, other)


def test_two_threads_change_less_than_single_precision_does():
    gaussians, pose = random_map("ordinary", 600, 8), random_pose(1).float()
    parts = converted(gaussians, torch.float32), Camera(70.0, 65.0, 60.0, 45.0, 120, 90), pose
    threads, found = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        rendering, leaves = gradients(render, *parts, torch.zeros(6), 0)
        found.append([values.detach() for values in (*rendering[:3], *leaves)])
    torch.set_num_threads(threads)
    for one, two in zip(*found, strict=True):
        assert float((one - two).norm() / one.norm()) < 1e-6  # sums in another order: 2e-7


def test_float32_follows_float64():
    gaussians, pose = random_map("ordinary", 300, 3), random_pose(3)
    camera = Camera(70.0, 65.0, 31.0, 25.0, 61, 45)
    single = converted(gaussians, torch.float32)
    exact = converted(single, torch.float64)
    twist = torch.zeros(6, dtype=torch.float64)
    ours, our_gradients = gradients(render, single, camera, pose, twist.float(), 3)
    twin, twin_gradients = gradients(render, exact, camera, pose, twist, 3)
    # A pixel at the threshold 1/255 may flip: compare in the mean, and gradients in the norm.
    assert (ours.color - twin.color).abs().mean().item() < 1e-5
    for one, other in zip(our_gradients, twin_gradients, strict=True):
        assert one.dtype == torch.float32
        assert float((one - other).norm() / other.norm()) < 1e-2


# Gradients


def test_gradcheck_of_the_whole_renderer():
    camera = Camera(11.0, 12.5, 5.2, 4.4, 12, 9)
    gaussians, pose = random_map("ordinary", 6, 4), random_pose(4)

    def image(*values: Tensor) -> tuple[Tensor, ...]:
        rendering = render(
            GaussianMap(*values[:5], gaussians.anchor_keyframe), camera, pose,
            torch.tensor([0.1, 0.5, 0.9]), twist=values[5], screen_offsets=values[6],
        )  # fmt: skip
        return rendering[:3]

    inputs = [*gaussians.parameters.values(), torch.zeros(6), torch.zeros(6, 2)]
    inputs = [value.double().clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(image, inputs)


@pytest.mark.parametrize("seed", range(20))
def test_pose_gradient_against_differences(seed: int):
    gaussians, camera, pose = random_map("huge", 8, seed), random_camera(seed), random_pose(seed)
    zero = torch.zeros(6, dtype=torch.float64)
    _, everything = gradients(render, gaussians, camera, pose, zero, seed)
    background = torch.rand(3, generator=generator(seed), dtype=torch.float64)
    numerical = numerical_gradient(
        lambda twist: loss_of(render(gaussians, camera, pose, background, twist), seed), zero
    )
    assert_gradients_close(everything[5], numerical, relative=1e-6)


@pytest.mark.parametrize("name", ["means", "quats_wxyz", "log_scales", "opacity_logits", "colors"])
def test_only_what_asks_gets_a_gradient(name: str):
    gaussians, camera, pose = random_map("ordinary", 20, 5), random_camera(5), random_pose(5)
    _, everything = gradients(render, gaussians, camera, pose, torch.zeros(6).double(), 5)
    background = torch.rand(3, generator=generator(5), dtype=torch.float64)
    gaussians.parameters[name].requires_grad_()
    loss_of(render(gaussians, camera, pose, background), 5).backward()
    for number, (other, value) in enumerate(gaussians.parameters.items()):
        assert (value.grad is not None) == (other == name)
        if other == name:
            torch.testing.assert_close(value.grad, everything[number])


def test_tracking_needs_no_gradient_of_the_map():
    gaussians, camera, pose = random_map("ordinary", 20, 6), random_camera(6), random_pose(6)
    _, everything = gradients(render, gaussians, camera, pose, torch.zeros(6).double(), 6)
    background = torch.rand(3, generator=generator(6), dtype=torch.float64)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    loss_of(render(gaussians, camera, pose, background, twist), 6).backward()
    torch.testing.assert_close(twist.grad, everything[5])


def test_loss_on_one_image_alone_works():
    gaussians = with_leaves(one_gaussian())
    camera = Camera(60.0, 60.0, 12.0, 9.0, 27, 21)
    rendering = render(gaussians, camera, torch.eye(4))
    rendering.opacity.sum().backward()
    assert gaussians.colors.grad.abs().max() == 0
    assert gaussians.opacity_logits.grad[0] > 0


# Boundaries


def test_capped_and_invisible_gaussians_have_no_gradient():
    camera = Camera(60.0, 60.0, 12.0, 9.0, 27, 21)
    capped = with_leaves(one_gaussian(opacity=0.995))
    render(capped, camera, torch.eye(4)).opacity.sum().backward()
    assert capped.opacity_logits.grad[0] == 0
    assert capped.log_scales.grad.abs().sum() > 0
    for gaussians in (
        one_gaussian((0, 0, -1)),
        one_gaussian((0, 0, 0)),
        one_gaussian(opacity=1e-3),
    ):
        unseen = with_leaves(gaussians)
        render(unseen, camera, torch.eye(4)).color.sum().backward()
        for value in unseen.parameters.values():
            assert value.grad.abs().max() == 0


@pytest.mark.parametrize("fault", ["zero quaternion", "infinite scale", "huge scale", "nan mean"])
def test_one_broken_gaussian_does_not_spoil_the_others(fault: str):
    camera, pose = Camera(60.0, 60.0, 12.0, 9.0, 27, 21), torch.eye(4)
    broken = converted(random_map("ordinary", 20, 8), torch.float32)
    if fault == "zero quaternion":
        broken.quats_wxyz[3] = 0
    elif fault == "nan mean":
        broken.means[3] = float("nan")
    else:
        broken.log_scales[3] = 100.0 if fault == "infinite scale" else 40.0
    gaussians = with_leaves(broken)
    twist = torch.zeros(6, requires_grad=True)
    rendering = render(gaussians, camera, pose, twist=twist)
    rendering.color.sum().backward()
    assert rendering.color.isfinite().all() and rendering.color.sum() > 0
    assert twist.grad.isfinite().all() and twist.grad.abs().sum() > 0
    others = torch.arange(20) != 3
    for value in gaussians.parameters.values():
        assert value.grad[others].isfinite().all()


def test_flushing_denormals_does_not_outlast_the_rendering():
    gaussians = with_leaves(one_gaussian())
    render(gaussians, Camera(60.0, 60.0, 12.0, 9.0, 27, 21), torch.eye(4)).color.sum().backward()
    assert float(torch.full((1,), 1e-38) * 0.1) > 0


# Use


def test_descent_recovers_a_displaced_camera():
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    gaussians = random_map("ordinary", 200, 7)
    target = render(gaussians, camera, torch.eye(4)).color
    twist = torch.tensor([0.03, -0.02, 0.02, 0.01, -0.02, 0.01]).double().requires_grad_()
    start = float(twist.detach().norm())
    optimizer = torch.optim.Adam([twist], lr=2e-3)
    for _ in range(100):
        optimizer.zero_grad()
        color = render(gaussians, camera, torch.eye(4), twist=twist).color
        (color - target).square().mean().backward()
        optimizer.step()
    assert float(twist.detach().norm()) < 0.25 * start
