import pytest
import torch

from minislam.geometry import se3_exp, so3_log
from minislam.geometry.se3 import rotation_from_quaternion
from minislam.mapping.deformation import deform_rigidly
from minislam.splatting import GaussianMap, render
from tests.helpers import generator, random_transforms
from tests.mapping.plane_scene import CAMERA


def random_map(count: int, dtype: torch.dtype = torch.float64) -> GaussianMap:
    source = generator(0)
    means = torch.rand(count, 3, generator=source, dtype=dtype) - 0.5
    means[:, 2] += 2
    return GaussianMap(
        means,
        torch.randn(count, 4, generator=source, dtype=dtype),
        torch.full((count, 3), -2.0, dtype=dtype)
        + 0.5 * torch.rand(count, 3, generator=source, dtype=dtype),
        torch.randn(count, generator=source, dtype=dtype),
        torch.rand(count, 3, generator=source, dtype=dtype),
        torch.zeros(count, dtype=torch.int64),
    )


# Identities


@pytest.mark.parametrize("regime", ["normal", "tiny", "half_turn"])
def test_the_moved_keyframe_sees_the_same_picture(regime):
    gaussians = random_map(30)
    rows = torch.zeros(30, dtype=torch.int64)
    old = torch.eye(4, dtype=torch.float64)[None]
    new = random_transforms(1, regime, 2)
    moved = deform_rigidly(gaussians, rows, old, new)
    before, after = render(gaussians, CAMERA, old[0]), render(moved, CAMERA, new[0])
    torch.testing.assert_close(after.color, before.color, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(after.depth, before.depth, rtol=1e-6, atol=1e-8)


def test_only_the_anchored_gaussians_move():
    gaussians = random_map(10)
    rows = torch.arange(10) % 2
    old = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    new = torch.stack([old[0], random_transforms(1, "normal", 3)[0]])
    moved = deform_rigidly(gaussians, rows, old, new)
    torch.testing.assert_close(moved.means[rows == 0], gaussians.means[rows == 0])
    assert (moved.means - gaussians.means)[rows == 1].norm(dim=-1).min() > 0.01


@pytest.mark.parametrize("angle", [1e-7, 1e-5, 1e-3, torch.pi])
def test_rotations_of_any_size_turn_means_and_axes_alike(angle):
    gaussians = random_map(5)
    motion = se3_exp(torch.tensor([[0, 0, 0, 0, angle, 0]], dtype=torch.float64))
    identity = torch.eye(4, dtype=torch.float64)[None]
    moved = deform_rigidly(gaussians, torch.zeros(5, dtype=torch.int64), motion, identity)
    turn = rotation_from_quaternion(moved.quats_wxyz) @ rotation_from_quaternion(
        gaussians.quats_wxyz
    ).transpose(-1, -2)
    torch.testing.assert_close(
        so3_log(turn).norm(dim=-1),
        torch.full((5,), angle, dtype=torch.float64),
        rtol=1e-6,
        atol=1e-12,
    )
