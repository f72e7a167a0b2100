"""`minislam export` on the folder of a small run, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest

from minislam.cli.main import main
from minislam.data.ply import read_ply
from tests.cli.test_main import images, run, texture

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run on two images."""
    root = tmp_path_factory.mktemp("export")
    source = images(root / "in", [texture(0), texture(3)])
    assert run(source, "-o", root / "run", "--mapping.refine_iterations", "2") == 0
    return root / "run"


def export(folder: Path, *arguments: object) -> int:
    return main(["export", str(folder), *map(str, arguments)])


def test_all_targets_at_once(folder: Path, tmp_path: Path, capsys):
    names = ["colmap", "my nerfstudio", "depth", "masks"]
    targets = [word for name in names for word in (f"--{name.split()[-1]}", tmp_path / name)]
    assert export(folder, *targets, "--points", tmp_path / "p.ply", "--sh-degree", 3) == 0
    said = capsys.readouterr().out
    assert f"to go on: ns-train splatfacto --data '{tmp_path}/my nerfstudio'" in said
    assert f"{tmp_path}/depth: 2 frames, lengths in" in said and "/masks: 2 frames\n" in said
    made = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    pictures = {f"{kind}/{n:06d}.png" for kind in ("images", "masks") for n in range(2)}
    both = {f"{name}/{picture}" for name in names[:2] for picture in pictures}
    model = {f"colmap/sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")}
    assert made == both | model | {
        "my nerfstudio/transforms.json", "my nerfstudio/points.ply", "p.ply", "depth/camera.json",
        "depth/000000.npy", "depth/000001.npy", "masks/000000.png", "masks/000001.png",
    }  # fmt: skip
    assert np.load(tmp_path / "depth/000001.npy").shape == (72, 96)
    assert len(read_ply(folder / "map_sh.ply")) == len(read_ply(folder / "map.ply"))


def test_what_is_written_may_lie_below_the_home_of_the_user(folder: Path, tmp_path, monkeypatch):
    (home := tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("USERPROFILE", str(home))
    monkeypatch.chdir(tmp_path)  # no shell makes a path of --points=~/p.ply
    kinds = ["--colmap=~/c", "--nerfstudio=~/n", "--depth=~/d", "--masks=~/m"]
    assert export(folder, "--points=~/p.ply", *kinds, "--keyframes") == 0
    assert {path.name for path in home.iterdir()} == {"c", "n", "d", "m", "p.ply"}
    assert main(["render", str(folder), "--output=~/fly.webp", "--path", "side-by-side"]) == 0
    path = str(folder / "trajectory.txt")
    kinds = ["--save_plot=~/a.png", "--save_results=~/a.json"]
    assert main(["eval", path, path, "--no_align", *kinds]) == 0
    assert [*tmp_path.iterdir()] == [home] and len([*home.iterdir()]) == 8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "expected at least one of --colmap"),
        (["--points", "mine.ply"], "expected a new file, but mine.ply exists"),
        (["--points", "new/sub/p.ply"], "new/sub is no writable folder; make it, or"),
        (["--depth", "mine"], "expected a new or empty output folder, found files in mine"),
        (["--masks", "mine.ply", "--overwrite"], "but mine.ply is a file"),
        (["--nerfstudio", "mine.ply/a/b"], "but mine.ply is a file; choose another name"),
    ],
)
def test_files_of_the_user_stay(arguments, words, folder: Path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for name in ("mine.ply", "mine/a.txt"):
        (tmp_path / name).write_text("mine")
    assert export(folder, *arguments) == 1
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.txt", "mine", "mine.ply"]
    assert (tmp_path / "mine.ply").read_text() == "mine"


def test_images_of_the_source_and_the_map_are_never_replaced(folder: Path, capsys):
    source, before = folder.parent / "in", (folder / "map.ply").read_bytes()
    images_before = [path.read_bytes() for path in sorted(source.iterdir())]
    for flag in ("--masks", "--depth", "--colmap"):
        assert export(folder, flag, source, "--overwrite") == 1
        assert "without images of the sequence itself, or links to" in capsys.readouterr().err
    assert [path.read_bytes() for path in sorted(source.iterdir())] == images_before
    assert export(folder, "--points", folder / "map.ply", "--overwrite") == 1
    assert "exists and is an input" in capsys.readouterr().err
    assert (folder / "map.ply").read_bytes() == before


def test_a_folder_without_a_run_is_refused(tmp_path: Path, capsys):
    assert export(tmp_path / "nowhere", "--points", tmp_path / "a.ply") == 1
    assert "expected a run folder" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
