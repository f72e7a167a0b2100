"""Known answers of Eqs. (1) and (2), asked of the slow twin and of the fast renderer."""

from collections.abc import Callable

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera, se3_exp, se3_inverse
from minislam.geometry.se3 import quaternion_from_rotation, rotation_from_quaternion
from minislam.splatting import GaussianMap, render, render_reference
from minislam.splatting.constants import LOW_PASS_VARIANCE, NEAR_DEPTH
from tests.splatting.scenes import one_gaussian, random_camera, random_map, random_pose

IDENTITY = torch.eye(4, dtype=torch.float64)
CAMERA = Camera(60.0, 60.0, 12.0, 9.0, 27, 21)

both = pytest.mark.parametrize("renderer", [render, render_reference], ids=["fast", "reference"])
close = dict(rtol=1e-11, atol=1e-12)


@both
def test_profile_of_one_gaussian(renderer: Callable):
    # sigma'^2 = (60 * 0.2 / 2)^2 + 0.3 = 36.3 px^2; alpha = 0.8 exp(-r^2 / 72.6), cut at 1/255.
    rendering = renderer(one_gaussian(), CAMERA, IDENTITY)
    u, v = CAMERA.pixel_grid(dtype=torch.float64).unbind(-1)
    alpha = 0.8 * torch.exp(-((u - 12) ** 2 + (v - 9) ** 2) / (2 * (36 + LOW_PASS_VARIANCE)))
    alpha = alpha * (alpha > 1 / 255)
    torch.testing.assert_close(rendering.opacity, alpha, **close)
    torch.testing.assert_close(rendering.depth, 2 * alpha, **close)
    color = torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64)
    torch.testing.assert_close(rendering.color, alpha[..., None] * color, **close)
    assert rendering.opacity.argmax() == 9 * CAMERA.width + 12
    assert rendering.weight_sums[0].item() == pytest.approx(alpha.sum().item())


@both
def test_total_opacity_is_the_integral_of_the_profile(renderer: Callable):
    # Sum over pixels of o exp(-r^2 / 2 s^2) = 2 pi s^2 o; what the cut at 1/255 removes is
    # 2 pi s^2 / 255, since exp(-r^2 / 2 s^2) is uniform under the area 2 pi s^2.
    camera = Camera(60.0, 60.0, 40.0, 40.0, 81, 81)
    rendering = renderer(one_gaussian(scale=0.3), camera, IDENTITY)
    variance = 81 + LOW_PASS_VARIANCE
    expected = 2 * torch.pi * variance * (0.8 - 1 / 255)
    assert rendering.opacity.sum().item() == pytest.approx(expected, rel=1e-3)


@both
def test_near_gaussian_covers_the_far_one(renderer: Callable):
    # On the axis: 0.5 of the front, then 0.8 of the remaining half, then the background.
    front = one_gaussian((0, 0, 1), opacity=0.5, color=(1, 0, 0))
    back = one_gaussian((0, 0, 3), opacity=0.8, color=(0, 1, 0))
    background = torch.tensor([0, 0, 1], dtype=torch.float64)
    for gaussians in (front.concatenate(back), back.concatenate(front)):
        rendering = renderer(gaussians, CAMERA, IDENTITY, background)
        expected = torch.tensor([0.5, 0.4, 0.1], dtype=torch.float64)
        torch.testing.assert_close(rendering.color[9, 12], expected, **close)
        assert rendering.depth[9, 12].item() == pytest.approx(0.5 * 1 + 0.4 * 3)
        assert rendering.opacity[9, 12].item() == pytest.approx(0.9)


@both
def test_order_of_the_map_does_not_matter(renderer: Callable):
    gaussians, camera, pose = random_map("ordinary", 30, 1), random_camera(1), random_pose(1)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    shuffled = GaussianMap(*[t[order] for t in [*gaussians.parameters.values()]], order)
    straight, mixed = renderer(gaussians, camera, pose), renderer(shuffled, camera, pose)
    for ours, theirs in zip(straight[:3], mixed[:3], strict=True):
        torch.testing.assert_close(ours, theirs, **close)
    torch.testing.assert_close(straight.weight_sums[order], mixed.weight_sums, **close)


@both
def test_ties_in_depth_keep_the_order_of_the_map(renderer: Callable):
    first = one_gaussian(opacity=0.9, color=(1, 0, 0))
    second = one_gaussian(opacity=0.9, color=(0, 1, 0))
    color = renderer(first.concatenate(second), CAMERA, IDENTITY).color[9, 12]
    torch.testing.assert_close(color.tolist(), [0.9, 0.09, 0.0])


@both
def test_weights_and_transmittance_add_up_to_one(renderer: Callable):
    gaussians, camera, pose = random_map("crowded", 60, 2), random_camera(2), random_pose(2)
    white = GaussianMap(
        *[*gaussians.parameters.values()][:-1], torch.ones(60, 3).double(), torch.arange(60)
    )
    rendering = renderer(white, camera, pose, torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(rendering.color, torch.ones_like(rendering.color), **close)
    total = rendering.weight_sums.sum()
    torch.testing.assert_close(total, rendering.opacity.sum(), **close)


@both
def test_moving_world_and_camera_together_changes_nothing(renderer: Callable):
    gaussians, camera, pose = random_map("ordinary", 30, 3), random_camera(3), random_pose(3)
    motion = se3_exp(torch.tensor([0.4, -2.0, 1.0, 0.7, -1.1, 2.0], dtype=torch.float64))
    rotations = motion[:3, :3] @ rotation_from_quaternion(gaussians.quats_wxyz)
    moved = GaussianMap(
        gaussians.means @ motion[:3, :3].T + motion[:3, 3], quaternion_from_rotation(rotations),
        gaussians.log_scales, gaussians.opacity_logits, gaussians.colors, gaussians.anchor_keyframe,
    )  # fmt: skip
    ours = renderer(gaussians, camera, pose)
    theirs = renderer(moved, camera, pose @ se3_inverse(motion))
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


@both
def test_a_larger_world_looks_the_same_and_is_deeper(renderer: Callable):
    gaussians, camera = random_map("ordinary", 30, 4), random_camera(4)
    larger = GaussianMap(
        3 * gaussians.means, gaussians.quats_wxyz,
        gaussians.log_scales + torch.tensor(3.0).double().log(),
        gaussians.opacity_logits, gaussians.colors, gaussians.anchor_keyframe,
    )  # fmt: skip
    ours, theirs = renderer(gaussians, camera, IDENTITY), renderer(larger, camera, IDENTITY)
    torch.testing.assert_close(ours.color, theirs.color, **close)
    torch.testing.assert_close(3 * ours.depth, theirs.depth, **close)


@both
def test_cropping_the_camera_crops_the_image(renderer: Callable):
    # Tiles start elsewhere: nothing may depend on where a tile ends.
    camera = Camera(60.0, 55.0, 20.0, 15.0, 41, 33)
    gaussians = random_map("ordinary", 40, 5)
    gaussians = gaussians.keep(gaussians.means[:, :2].norm(dim=1) < 0.5)
    whole = renderer(gaussians, camera, IDENTITY)
    part = renderer(gaussians, camera.cropped(5, 3, 30, 27), IDENTITY)
    torch.testing.assert_close(part.color, whole.color[3:30, 5:35], **close)


@both
def test_a_twist_moves_the_camera(renderer: Callable):
    gaussians, camera, pose = random_map("ordinary", 30, 6), random_camera(6), random_pose(6)
    twist = 0.05 * torch.randn(6, generator=torch.Generator().manual_seed(1)).double()
    ours = renderer(gaussians, camera, pose, twist=twist)
    theirs = renderer(gaussians, camera, se3_exp(twist) @ pose)
    torch.testing.assert_close(ours.color, theirs.color, **close)


# Boundaries


@both
def test_near_plane(renderer: Callable):
    def opacity(z: float) -> float:
        shown = renderer(one_gaussian((0, 0, z), scale=0.001), CAMERA, IDENTITY)
        return shown.opacity[9, 12].item()

    assert opacity(NEAR_DEPTH * (1 - 1e-9)) == 0
    assert opacity(NEAR_DEPTH * (1 + 1e-9)) == pytest.approx(0.8)


@both
def test_faint_and_capped_opacities(renderer: Callable):
    def peak(opacity: float) -> float:
        return renderer(one_gaussian(opacity=opacity), CAMERA, IDENTITY).opacity.max().item()

    assert peak(1 / 255 * (1 - 1e-9)) == 0
    assert peak(1 / 255 * (1 + 1e-9)) == pytest.approx(1 / 255)
    assert peak(0.999) == pytest.approx(0.99)


@both
def test_nothing_to_see_is_the_background(renderer: Callable):
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    empty = one_gaussian((0, 0, 1)).keep(torch.tensor([False]))
    for gaussians in (empty, one_gaussian((0, 0, -1)), one_gaussian((9, 0, 1))):
        rendering = renderer(gaussians, CAMERA, IDENTITY, background)
        assert rendering.color.shape == (21, 27, 3)
        torch.testing.assert_close(rendering.color[3, 4], background)
        assert rendering.opacity.abs().max() == 0 and rendering.depth.abs().max() == 0
        assert rendering.weight_sums.sum() == 0


# Errors


def test_a_pose_of_wrong_shape_is_refused():
    with pytest.raises(InputError, match=r"\(4, 4\)"):
        render(one_gaussian(), CAMERA, torch.eye(3))
