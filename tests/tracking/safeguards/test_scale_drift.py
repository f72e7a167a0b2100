"""A drift of the scale: a known one is undone, and what the prior may err itself is left alone."""

import pytest
import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.safeguards.scale_drift import told_drift, undo_scale_drift
from tests.helpers import generator

CELLS, KEYFRAMES = 60, 120


def walk() -> Tensor:
    """Return true poses (K, 4, 4): a way with turns."""
    source = generator(0)
    twists = 0.05 * torch.randn(KEYFRAMES, 6, generator=source, dtype=torch.float64)
    twists[:, 2] += 0.1
    poses = [torch.eye(4, dtype=torch.float64)]
    for twist in twists[1:]:
        poses.append(se3_exp(twist) @ poses[-1])
    return torch.stack(poses)


def store_with(drift: Tensor, frame_noise: float = 0.0, every: int = 1) -> KeyframeStore:
    """Return keyframes whose lengths are exp(-drift) of the true ones; a prior of every n-th."""
    source = generator(1)
    true = 0.2 + torch.rand(KEYFRAMES, CELLS, generator=source)
    noise = 1 + frame_noise * torch.randn(KEYFRAMES, 1, generator=source)
    noise = noise * (1 + 0.1 * torch.randn(KEYFRAMES, CELLS, generator=source))
    keyframes = KeyframeStore(true[0])
    keyframes.set_geometry(shortened(walk(), drift), true * drift.exp().float()[:, None])
    keyframes.prior_disparities = torch.zeros_like(true)
    keyframes.prior_disparities[::every] = (true * noise)[::every]
    return keyframes


def shortened(T_camera_world: Tensor, drift: Tensor) -> Tensor:
    poses = se3_inverse(T_camera_world)
    steps = poses[:, :3, 3].diff(dim=0) * ((-drift[1:] - drift[:-1]) / 2).exp()[:, None]
    poses[1:, :3, 3] = poses[0, :3, 3] + steps.cumsum(0)
    return se3_inverse(poses)


def bend(size: float) -> Tensor:
    """Return a drift (K,) of this standard deviation, 0 in the mean."""
    line = torch.linspace(-1, 1, KEYFRAMES, dtype=torch.float64)
    return size * (line - line.mean()) / line.std()


def centre_error(keyframes: KeyframeStore) -> float:
    centres = se3_inverse(keyframes.T_camera_world)[:, :3, 3]
    truth = se3_inverse(walk())[:, :3, 3]
    centres, truth = centres - centres.mean(0), truth - truth.mean(0)
    scale = (centres * truth).sum() / centres.square().sum()
    return float((scale * centres - truth).norm() / truth.norm())


def test_a_drift_is_told_but_for_the_part_that_the_prior_may_err():
    drift = bend(0.2)
    found = told_drift(store_with(drift))
    kept = float(found @ drift / drift.square().sum())
    assert kept == pytest.approx(1 - 0.03**2 / 0.2**2, abs=0.05)  # less what the ends lose
    assert (found - kept * drift).abs().max() < 0.06


def test_undoing_it_brings_steps_and_depths_back_and_keeps_all_turns():
    keyframes = store_with(bend(0.2), frame_noise=0.05)
    before, turns = centre_error(keyframes), keyframes.T_camera_world[:, :3, :3].clone()
    undo_scale_drift(keyframes)
    assert centre_error(keyframes) < 0.25 * before
    torch.testing.assert_close(keyframes.T_camera_world[:, :3, :3], turns)
    ratio = (keyframes.disparities / store_with(bend(0.0)).disparities).log()
    assert ratio.mean(1).std() < 0.05
    assert torch.equal(keyframes.T_camera_world[0], walk()[0])  # the first camera is the world


def test_steps_and_disparities_stay_consistent():
    """What a pair of neighbours sees of each other does not change: t d is the same."""
    keyframes = store_with(bend(0.2))
    drift = told_drift(keyframes)
    centres, disparities = se3_inverse(keyframes.T_camera_world)[:, :3, 3], keyframes.disparities
    undo_scale_drift(keyframes)
    new = se3_inverse(keyframes.T_camera_world)[:, :3, 3]
    relative = (new.diff(dim=0).norm(dim=1) / centres.diff(dim=0).norm(dim=1)).log()
    torch.testing.assert_close(relative, (drift[1:] + drift[:-1]) / 2)
    change = (keyframes.disparities / disparities).log().double()
    torch.testing.assert_close(change, -drift[:, None].expand_as(change), atol=1e-5, rtol=0)


@pytest.mark.parametrize("every", [1, 20])
@pytest.mark.parametrize("size", [0.0, 0.02])
def test_a_drift_that_the_prior_may_have_itself_is_left_alone(size: float, every: int):
    keyframes = store_with(bend(size), frame_noise=0.05, every=every)
    before = keyframes.T_camera_world, keyframes.disparities
    undo_scale_drift(keyframes)
    assert keyframes.T_camera_world is before[0] and keyframes.disparities is before[1]


def test_few_keyframes_with_a_prior_tell_a_large_drift():
    keyframes = store_with(bend(0.2), every=5)
    before = centre_error(keyframes)
    undo_scale_drift(keyframes)
    assert centre_error(keyframes) < 0.4 * before


@pytest.mark.parametrize("every", [KEYFRAMES, KEYFRAMES + 1])
def test_one_prior_or_none_tells_nothing(every: int):
    keyframes = store_with(bend(0.2), every=every)
    if every > KEYFRAMES:
        keyframes.prior_disparities[:] = 0
    assert not told_drift(keyframes).any()
