"""`minislam render` from the command line: files that play, and sentences where it cannot."""

from pathlib import Path

import cv2
import pytest

from minislam.cli.main import main

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


def test_nonsense_is_one_sentence(folder: str, tmp_path: Path, capsys):
    assert main(["render", str(tmp_path), "-o", "a.webm"]) == 1
    assert "expected a run with a map" in capsys.readouterr().err
    assert main(["render", folder, "--size", "99999x72", "-o", str(tmp_path / "a.webm")]) == 1
    assert "--size of at least 16 and at most 16384" in capsys.readouterr().err
    assert main(["render", folder, "-o", str(tmp_path / "a.gif")]) == 1
    assert "ends in .webm or .webp, found .gif" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
