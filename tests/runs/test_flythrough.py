"""Where the camera flies, and that input, beta and map stand beside each other."""

import tempfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.runs import flythrough
from minislam.runs.loaded import SourceFrame

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


class FakeRun:
    """A run whose renderings are grey by the frame's number and whose poses are recorded."""

    def __init__(self, count: int = 7, depth: float = 2.0) -> None:
        self.camera = CAMERA
        level = [1.0, 1.0, 2.0]  # the camera made blue brighter in the last frame
        self.frames = [SourceFrame(i, i / 12, f"{i}.png", i % 3 == 0) for i in range(count)]
        self.frames[-1] = replace(self.frames[-1], exposure=level)
        self.keyframes = [frame.index for frame in self.frames if frame.keyframe]
        self.poses = {i: np.eye(4) for i in range(count)}
        for index, pose in self.poses.items():
            pose[0, 3] = index
        self.seen: list[np.ndarray] = []
        self.depth = depth
        self.sequence = SimpleNamespace(
            frame=lambda i: SimpleNamespace(image=torch.full((48, 64, 3), i / 10))
        )

    def render(
        self, pose: np.ndarray, camera: Camera, exposure: list[float] | None = None
    ) -> np.ndarray:
        self.seen.append(pose)
        return np.full((camera.height, camera.width, 3), 0.25) * (exposure or 1.0)

    def render_depth(self, pose: np.ndarray) -> np.ndarray:
        return np.full((48, 64), self.depth)

    def beta(self, index: int) -> np.ndarray:
        return np.full((48, 64), 0.1 if index < 3 else 5.0, np.float32)


def test_a_film_shows_as_many_images_per_second_as_the_run_has():
    assert flythrough.frame_rate(FakeRun()) == pytest.approx(12)


def test_the_circle_looks_at_one_point_from_one_distance():
    run = FakeRun()
    assert len(list(flythrough.fly_around(run, CAMERA))) == flythrough.ORBIT_IMAGES
    target = run.poses[run.keyframes[1]] @ [0, 0, 2.0, 1]
    for pose in run.seen:
        seen = np.linalg.inv(pose) @ target
        assert np.abs(seen[:2] / seen[2]).max() < 2e-3  # close to the principal point
        radius = np.linalg.norm(pose[:3, 3] - run.poses[3][:3, 3])
        assert radius == pytest.approx(0.2)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    with pytest.raises(InputError, match="expected a map in front"):
        next(flythrough.fly_around(FakeRun(depth=0.0), CAMERA))


def test_panels_beside_each_other_in_one_scale_of_beta():
    run = FakeRun()
    rows = list(flythrough.side_by_side(run, CAMERA))
    np.testing.assert_array_equal([pose[0, 3] for pose in run.seen], range(7))
    assert rows[4].shape == (48, 3 * 64, 3)
    assert rows[4][40, 30] == pytest.approx([0.4] * 3, abs=0.01)
    assert rows[4][40, 160] == pytest.approx([0.25] * 3, abs=0.01)
    assert rows[6][40, 160] == pytest.approx([0.25, 0.25, 0.5], abs=0.01)  # as bright as the input
    assert rows[0][40, 96].sum() < 0.1 < 2 < rows[6][40, 96].sum()


def test_a_clip_of_a_long_run_keeps_its_duration():
    run = FakeRun(count=130)
    images, rate = flythrough.clip(run)
    assert rate == pytest.approx(4)  # 12 per second, every third
    assert next(images).shape == (48, 3 * 64, 3)  # never enlarged
    run.camera = CAMERA.resized(640, 480)
    assert next(flythrough.clip(run)[0]).shape == (180, 3 * 240, 3)


def test_a_run_does_not_end_because_there_is_no_space_for_its_clip(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError("no space for a temporary folder")

    monkeypatch.setattr(flythrough, "Run", lambda _: FakeRun())
    monkeypatch.setattr(tempfile, "TemporaryDirectory", full)
    flythrough.write_clip(str(tmp_path))
    assert not [*tmp_path.iterdir()]


def test_a_hole_in_the_map_does_not_keep_from_flying_around_it():
    run = FakeRun()
    depth = np.full((48, 64), 2.0)
    depth[:30] = 0
    run.render_depth = lambda pose: depth
    next(flythrough.fly_around(run, CAMERA))
    assert np.linalg.norm(run.seen[0][:3, 3] - run.poses[3][:3, 3]) == pytest.approx(0.2)


def test_white_stays_white():
    *_, last = flythrough.side_by_side(FakeRun(count=11), CAMERA)
    assert last[40, 30] == pytest.approx([1.0] * 3)
