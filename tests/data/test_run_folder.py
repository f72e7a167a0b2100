"""A run folder: what is written, what is refused, what is left alone."""

from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.data.images import read_color
from minislam.data.ply import GaussianArrays
from minislam.data.run_folder import RunFolder
from minislam.errors import InputError
from minislam.records import Trajectory
from tests.helpers import random_transforms
from tests.recordings import picture, save


def fill(run: RunFolder) -> None:
    trajectory = Trajectory(np.arange(3.0), random_transforms(3, "normal", 0).numpy())
    ones = np.ones((2, 3), np.float32)
    run.write_config({"tracking": {"window": 8}})
    run.write_run({"seed": 0, "state": "ok"})
    run.write_metrics({"ate_rmse_world_units": 0.01})
    run.write_trajectory(trajectory)
    run.write_keyframe_trajectory(trajectory)
    run.write_lost_frames([(7, 0.233333, "too few matches")])
    run.write_map(GaussianArrays(ones, ones, np.ones((2, 4), np.float32), np.zeros(2), ones))
    run.write_mlp({"0.weight": torch.arange(6.0).reshape(2, 3)})
    run.write_keyframe_image(123, "input", picture(1) / 255)
    run.write_plot("trajectory", b"png")
    run.write_report("<html></html>")


# Known answers


def test_the_files_of_a_run(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out" / "desk")
    fill(run)
    files = {str(path.relative_to(run.path)) for path in run.path.rglob("*") if path.is_file()}
    assert files == {
        "config.json", "run.json", "metrics.json", "trajectory.txt", "keyframe_trajectory.txt",
        "lost_frames.txt", "map.ply", "uncertainty_mlp.pt", "keyframes/000123_input.png",
        "plots/trajectory.png", "report.html",
    }  # fmt: skip
    lines = (run.path / "lost_frames.txt").read_text().splitlines()
    assert lines == ["# frame_index timestamp reason", "7 0.233333 too few matches"]


def test_everything_can_be_read_back(tmp_path: Path):
    fill(RunFolder.create(tmp_path / "out"))
    run = RunFolder(tmp_path / "out")
    assert run.read_config() == {"tracking": {"window": 8}}
    assert run.read_run()["state"] == "ok"
    assert run.read_metrics() == {"ate_rmse_world_units": 0.01}
    assert len(run.read_trajectory()) == len(run.read_keyframe_trajectory()) == 3
    assert len(run.read_map()) == 2
    assert torch.equal(run.read_mlp()["0.weight"], torch.arange(6.0).reshape(2, 3))
    image = read_color(run.path / "keyframes/000123_input.png")
    np.testing.assert_array_equal(image, picture(1))


def test_the_same_content_gives_the_same_bytes(tmp_path: Path):
    runs = [RunFolder.create(tmp_path / name) for name in ("first", "second")]
    for run in runs:
        fill(run)
    for path in runs[0].path.rglob("*.*"):
        twin = runs[1].path / path.relative_to(runs[0].path)
        assert path.read_bytes() == twin.read_bytes(), path.name


# Overwriting


def test_results_are_replaced_only_when_asked_and_foreign_files_never(tmp_path: Path):
    fill(RunFolder.create(tmp_path / "out"))
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="--overwrite"):
        RunFolder.create(tmp_path / "out")
    assert (tmp_path / "out" / "map.ply").is_file()
    RunFolder.create(tmp_path / "out", overwrite=True)
    left = [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert left == ["notes.txt"]


def test_an_empty_folder_is_accepted(tmp_path: Path):
    (tmp_path / "out").mkdir()
    RunFolder.create(tmp_path / "out")


# Errors


def test_a_file_or_a_missing_folder_is_no_run(tmp_path: Path):
    path = save(tmp_path / "out.png", picture(0))
    with pytest.raises(InputError, match="is a file"):
        RunFolder.create(path)
    with pytest.raises(InputError, match="be able to write"):
        RunFolder.create(path / "inside")
    with pytest.raises(InputError, match="run folder"):
        RunFolder(tmp_path / "missing")


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(InputError, match=r"out.*Permission denied"):
        RunFolder.create(tmp_path / "out")


def test_damaged_weights_are_named(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out")
    run.write_mlp({"a": torch.zeros(100)})
    path = run.path / "uncertainty_mlp.pt"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"uncertainty_mlp\.pt"):
        run.read_mlp()


def test_names_cannot_leave_the_folder(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out")
    with pytest.raises(AssertionError):
        run.write_plot("../escape", b"")
    with pytest.raises(AssertionError):
        run.write_keyframe_image(1, "../x", picture(0))
