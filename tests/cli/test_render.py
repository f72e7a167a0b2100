"""`minislam render` from the command line: files that play, and sentences where it cannot."""

from pathlib import Path

import cv2
import pytest

from minislam.cli.main import main
from minislam.data.run_folder import RunFolder
from minislam.runs.loaded import Run
from minislam.runs.warnings import BROKEN

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(root: Path) -> str:
    command = ["run", "synth:person", "--stride", "3", "--max-frames", "5", "--size", "96x72"]
    assert main([*command, "--preset", "test", "-o", str(root / "run")]) == 0
    return str(root / "run")


@pytest.mark.parametrize(
    ("path", "count", "width"), [("trajectory", 5, 64), ("orbit", 90, 64), ("side-by-side", 5, 192)]
)
def test_paths(folder: str, tmp_path: Path, capsys, path: str, count: int, width: int):
    file = tmp_path / "fly.webp"
    assert main(["render", folder, "--path", path, "--size", "64x48", "-o", str(file)]) == 0
    _, animation = cv2.imreadanimation(str(file))
    assert len(animation.frames) == count and animation.frames[0].shape[:2] == (48, width)
    assert str(file) in capsys.readouterr().out


def test_a_run_leaves_its_clip(folder: str):
    _, animation = cv2.imreadanimation(str(Path(folder) / "clip.webp"))
    assert len(animation.frames) == 5


def test_breaks_of_the_run_are_warned_of(folder: str, tmp_path: Path, monkeypatch, capsys):
    said = [f"{BROKEN} at frames 2 to 3", "without a depth prior the unit of length is arbitrary"]
    facts = RunFolder(folder).read_run() | {"warnings": said}
    monkeypatch.setattr(RunFolder, "read_run", lambda self: facts)
    to_film = ["render", folder, "--size", "32x24", "-o", str(tmp_path / "fly.webp")]
    for command in (to_film, ["export", folder, "--points", str(tmp_path / "points.ply")]):
        assert main(command) == 0
        warned = [line for line in capsys.readouterr().err.splitlines() if "WARNING" in line]
        assert warned == [f"WARNING: {said[0]}"]


def test_nonsense_is_one_sentence(folder: str, tmp_path: Path, capsys):
    assert main(["render", str(tmp_path), "-o", "a.webm"]) == 1
    assert "expected a run with a map" in capsys.readouterr().err
    assert main(["render", folder, "--size", "99999x72", "-o", str(tmp_path / "a.webm")]) == 1
    assert "--size of at least 16 and at most 16383" in capsys.readouterr().err
    beside = ["--path", "side-by-side", "--size", "5462x72", "-o", str(tmp_path / "a.webm")]
    assert main(["render", folder, *beside]) == 1  # before it renders three panels of that width
    assert "--size of at least 16 and at most 5461, found" in capsys.readouterr().err
    assert main(["render", folder, "-o", str(tmp_path / "a.gif")]) == 1
    assert "ends in .webm or .webp, found .gif; write .webm, and convert" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_if_asked_for_and_the_source_never(
    folder: str, tmp_path: Path, monkeypatch, capsys
):
    film, source = tmp_path / "fly.webp", tmp_path / "my.webm"
    film.write_bytes(b"mine")
    source.write_bytes(b"video")
    command = ["render", folder, "--size", "32x24", "-o"]
    assert main([*command, str(film)]) == 1
    assert f"expected a new file, but {film} exists" in capsys.readouterr().err
    assert film.read_bytes() == b"mine"
    assert main([*command, str(film), "--overwrite"]) == 0
    assert film.read_bytes()[:4] == b"RIFF"
    capsys.readouterr()
    monkeypatch.setattr(RunFolder, "read_config", lambda self: {"sequence": str(source)})
    for more in ([], ["--overwrite"]):
        assert main([*command, str(source), *more]) == 1
        assert f"expected a new file, but {source} exists" in capsys.readouterr().err
        assert source.read_bytes() == b"video"
    (tmp_path / "link.webm").symlink_to(source)
    assert main([*command, str(tmp_path / "link.webm"), "--overwrite"]) == 1
    assert "exists and is an input; choose another name" in capsys.readouterr().err
    assert source.read_bytes() == b"video"


def test_a_folder_that_is_not_there_is_said_before_the_film_is_made(
    folder: str, tmp_path: Path, monkeypatch, capsys
):
    monkeypatch.setattr(Run, "render", lambda *_: pytest.fail("it renders"))
    assert main(["render", folder, "-o", str(tmp_path / "new/x/a.webm")]) == 1
    said = capsys.readouterr().err
    assert f"{tmp_path}/new/x is no writable folder; make it, or choose another" in said
