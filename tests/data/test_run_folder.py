"""A run folder: what is written, what is refused, what is left alone."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.data.images import encode_png, read_color
from minislam.data.ply import GaussianArrays, encode_ply, read_ply
from minislam.data.run_folder import RunFolder, locked
from minislam.data.trajectory import read_trajectory, write_trajectory
from minislam.errors import InputError
from minislam.records import Trajectory
from tests.helpers import random_transforms
from tests.recordings import picture, save

JSON = {
    "config.json": {
        "sequence": "desk",
        "input": {},
        "priors": {},
        "tracking": {"window": 8},
        "mapping": {},
    },
    "run.json": {"seed": 0, "state": "ok"},
    "metrics.json": {"ate_rmse_world_units": 0.01},
}


def fill(run: RunFolder) -> None:
    trajectory = Trajectory(np.arange(3.0), random_transforms(3, "normal", 0).numpy())
    ones = np.ones((2, 3), np.float32)
    run.write_lost_frames([(7, 0.233333, "too few matches")])
    run.write_mlp({"0.weight": torch.arange(6.0).reshape(2, 3)})
    run.write_image("keyframes/000123_input.png", encode_png(picture(1)))
    run.write_image("plots/trajectory.png", b"png")
    for name in ("trajectory.txt", "keyframe_trajectory.txt"):
        write_trajectory(run.path / name, trajectory)
    gaussians = GaussianArrays(ones, ones, np.ones((2, 4), np.float32), np.zeros(2), ones)
    (run.path / "map.ply").write_bytes(encode_ply(gaussians))
    for name, text in JSON.items():
        (run.path / name).write_text(json.dumps(text))
    (run.path / "report.html").write_text("<html></html>")


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
    assert run.read_config() == JSON["config.json"]
    assert run.read_run()["state"] == "ok"
    assert run.read_metrics() == {"ate_rmse_world_units": 0.01}
    assert (
        len(run.read_trajectory())
        == len(read_trajectory(run.path / "keyframe_trajectory.txt"))
        == 3
    )
    assert len(read_ply(run.path / "map.ply")) == 2
    assert torch.equal(
        torch.load(run.path / "uncertainty_mlp.pt", weights_only=True)["0.weight"],
        torch.arange(6.0).reshape(2, 3),
    )
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
    left = {path.name for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert left == {"config.json", "notes.txt"}


def test_a_folder_whose_run_was_killed_as_it_began_is_taken(tmp_path: Path):
    begun = RunFolder.create(tmp_path / "out").path / "config.json.0123abcd.tmp"
    begun.write_text('{"sequ')
    RunFolder.create(tmp_path / "out", overwrite=True)
    assert not begun.exists()


def picture_of_mine(folder: Path) -> None:
    """A folder of the user's own pictures."""
    (folder / "keyframes").mkdir(parents=True)
    (folder / "keyframes/000001_input.png").write_text("mine")


def foreign_config(folder: Path) -> None:
    """A folder of another program that has a config.json, too."""
    picture_of_mine(folder)
    (folder / "config.json").write_text('{"tracking": {}, "mapping": {}}')


def linked_pictures(folder: Path) -> None:
    """A run folder whose pictures are somewhere else."""
    fill(RunFolder.create(folder))
    shutil.move(folder / "keyframes", folder.parent / "photos")
    (folder / "keyframes").symlink_to(folder.parent / "photos")


def linked_map(folder: Path) -> None:
    """A run folder whose map is somewhere else."""
    fill(RunFolder.create(folder))
    shutil.move(folder / "map.ply", folder.parent)
    (folder / "map.ply").symlink_to(folder.parent / "map.ply")


@pytest.mark.parametrize("make", [picture_of_mine, foreign_config, linked_pictures, linked_map])
def test_a_folder_that_may_be_another_s_is_left_alone(make, tmp_path: Path):
    make(tmp_path / "out")
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    with pytest.raises(InputError, match="nothing was removed"):
        RunFolder.create(tmp_path / "out", overwrite=True)
    after = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    assert after == before


def test_an_input_inside_is_left_alone(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out")
    fill(run)
    (tmp_path / "photos").symlink_to(run.path / "keyframes")
    for name in ("out/keyframes/000123_input.png", "photos/000123_input.png"):
        with pytest.raises(InputError, match=r"found .*123_input.png; nothing was removed"):
            RunFolder.create(run.path, overwrite=True, inputs=[tmp_path / name])
    assert (run.path / "keyframes/000123_input.png").is_file()
    RunFolder.create(run.path, overwrite=True, inputs=[tmp_path, tmp_path / "other"])


def test_only_names_that_a_run_writes_are_removed(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out")
    fill(run)
    mine = ["keyframes/holiday.png", "plots/thesis.png", "map.ply.tmp", "notes/map.ply"]
    ours = ["keyframes/0000123_beta.png", "map.ply.0123abcd.tmp", "plots/health.png.0123abcd.tmp"]
    for name in [*mine, *ours]:
        (run.path / name).parent.mkdir(exist_ok=True)
        (run.path / name).write_text("x")
    (run.path / "keyframes/link.txt").symlink_to(run.path / "notes")
    RunFolder.create(run.path, overwrite=True)
    left = {path.relative_to(run.path).as_posix() for path in run.path.rglob("*.*")}
    assert left == {"config.json", "keyframes/link.txt", *mine}
    for name in ours:
        (run.path / name).write_text("x")
    run.remove_checkpoint()  # and what is half written
    left = {path.relative_to(run.path).as_posix() for path in run.path.rglob("*.*")}
    assert left == {"config.json", "keyframes/link.txt", *mine, ours[0]}


def test_pictures_of_keyframes_that_were_given_up_are_removed_and_no_others(tmp_path: Path):
    pictures = RunFolder.create(tmp_path / "out").path / "keyframes"
    kept = {"000012_input.png", "holiday.png"}
    for name in [*kept, "000007_input.png", "000007_beta.png.0123abcd.tmp"]:
        (pictures / name).write_text("x")
    (pictures / "000009_beta.png").symlink_to(pictures / "holiday.png")
    RunFolder(tmp_path / "out").remove_other_keyframes({"keyframes/000012_input.png"})
    assert {path.name for path in pictures.iterdir()} == kept | {"000009_beta.png"}


def test_a_folder_is_locked_for_one_run_and_unlocked_by_its_end(tmp_path: Path):
    with locked(tmp_path / "out"):
        with pytest.raises(InputError, match="found another one in it"), locked(tmp_path / "out"):
            pass
        with locked(tmp_path / "other"):
            pass
    with locked(tmp_path / "out"):
        RunFolder.create(tmp_path / "out")
    assert not [path for path in (tmp_path / "out").iterdir() if path.is_file()]


def test_an_empty_folder_is_accepted(tmp_path: Path):
    (tmp_path / "out").mkdir()
    RunFolder.create(tmp_path / "out")


# Errors


@pytest.mark.parametrize("content", [b"", b"a text", b"PK\3\4" + bytes(40)])
def test_damaged_weights_are_one_sentence(content: bytes, tmp_path: Path):
    (tmp_path / "uncertainty_mlp.pt").write_bytes(content)
    with pytest.raises(InputError, match=r"expected the weights of the MLP in .*mlp\.pt"):
        RunFolder(tmp_path).read_mlp()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mine/a", "mine is a file; choose"),
        ("a" * 300, "make the folder (?s:.*)says: .*too long.*; choose"),
        ("a\0", "make the folder (?s:.*)says: .*null byte.*; choose"),
    ],
)
def test_a_folder_that_cannot_be_made_is_one_sentence(name: str, words: str, tmp_path: Path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(InputError, match=words), locked(tmp_path / name):
        RunFolder.create(tmp_path / name)
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_file_that_cannot_be_removed_is_one_sentence(tmp_path: Path, monkeypatch):
    def refuse(file: Path) -> None:
        raise PermissionError(13, "Permission denied")

    fill(RunFolder.create(tmp_path / "out"))
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(InputError, match=r"expected to remove .*out/.*, but: Perm.*; choose"):
        RunFolder.create(tmp_path / "out", overwrite=True)


def test_a_file_or_a_missing_folder_is_no_run(tmp_path: Path):
    path = save(tmp_path / "out.png", picture(0))
    with pytest.raises(InputError, match="is a file"):
        RunFolder.create(path)
    with pytest.raises(InputError, match="run folder"):
        RunFolder(tmp_path / "missing")


def test_names_cannot_leave_the_folder(tmp_path: Path):
    run = RunFolder.create(tmp_path / "out")
    for name in ("../escape.png", "plots/../health.png", "keyframes/000001_other.png"):
        with pytest.raises(AssertionError):
            run.write_image(name, b"")
