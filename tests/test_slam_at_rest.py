"""A camera that stands, or only turns, while a person walks by: a backdrop without the person."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth import default_intrinsics, render_frame, scene
from data_synth.poses import rigid
from data_synth.sequence import SyntheticFrame
from minislam.config import preset
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.evaluation.images import auroc, psnr
from minislam.images import resample
from minislam.priors.depth import NoDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.priors.interfaces import Priors
from minislam.slam import Slam
from tests.recordings import save

pytestmark = pytest.mark.slow

FRAMES, PACE = 16, 4  # every so many of the clip, so that the person walks far


def filmed(turn: float, size: tuple[int, int]) -> list[SyntheticFrame]:
    """Return what a camera sees that stands where the clip begins, and turns [degree a frame]."""
    view = scene("person", seed=1)
    start = view.path(0.0)

    def path(time: float) -> np.ndarray:  # (4, 4)
        angle = turn * time * 30 / PACE
        around = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        return start @ rigid(around, np.zeros(3))

    view = replace(view, path=path)
    return [render_frame(view, default_intrinsics(size), PACE * k) for k in range(FRAMES)]


@pytest.mark.parametrize(("turn", "size"), [(0.0, (160, 120)), (1.0, (240, 180))])
def test_what_a_camera_at_rest_sees_becomes_a_backdrop(turn: float, size, tmp_path: Path):
    seen = filmed(turn, size)
    for number, frame in enumerate(seen):
        save(tmp_path / f"rgb/{number:02d}.png", frame.rgb)
    k = default_intrinsics(size)
    options = InputOptions(size=size, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    priors = Priors(ClassicalFlow(), ClassicalFeatures(), NoDepth())
    slam = Slam(open_sequence(str(tmp_path / "rgb"), options), preset("test"), priors)
    slam.run()
    assert not slam.tracker.knows_depth and not slam.tracker.watch.breaks
    assert not slam.lost_frames() and slam.focal_length is None
    T_world_camera = slam.trajectory().T_world_camera
    assert np.abs(T_world_camera[:, :3, 3]).max() < 1e-9
    truth = [np.linalg.inv(seen[0].T_world_camera) @ frame.T_world_camera for frame in seen]
    error = np.linalg.inv(T_world_camera) @ truth
    assert Rotation.from_matrix(error[:, :3, :3]).magnitude().max() < np.radians(0.3)
    assert np.mean(slam.mapper.shown) > 0.98
    # Against the empty room (measured: 26.9 and 30.9 dB, AUROC .983 and .996).
    pairs = zip(map(slam.render, T_world_camera), seen, strict=True)
    assert np.mean([psnr(image, frame.static_rgb / 255) for image, frame in pairs]) > 25.5
    betas = [slam.mapper.predict_beta(priors.features(slam.frame(k))) for k in range(FRAMES)]
    betas = [resample(beta, *size[::-1]).numpy() for beta in betas]
    assert auroc(betas, [frame.mask for frame in seen]) > 0.96
