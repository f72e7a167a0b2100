"""The commands of README, made short, do what it says; what it only mentions is at least known."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from minislam.cli.main import _parser, main
from minislam.cli.options import take_settings
from tests.brief import brief_runs
from tests.cli.test_main import images, texture

pytestmark = pytest.mark.slow

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = "".join(re.findall(r"^```\n(.*?)^```", README, re.DOTALL | re.MULTILINE))
COMMANDS = re.findall(r"^minislam (.*?)\s*(?:#.*)?$", BLOCKS, re.MULTILINE)
MENTIONED = re.findall(r"(?<!`)`minislam ([a-z][^`]*)`(?!`)", README)
# What makes a command short. The first run leaves the folder that later lines look at.
SHORT = {
    "run": ["--preset", "test", "--max-frames", "3", "--size", "96x72", "--overwrite", "-q"],
    "render": ["--size", "32x24"],
}
OUTPUT = ["-o", "output/my_run"]


@pytest.fixture(scope="module", autouse=True)
def folder(root: Path) -> Iterator[Path]:
    """Stand where there are a video, photos with their depth, and the run of the first line."""
    with brief_runs(), pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        mp4v = cv2.VideoWriter_fourcc(*"mp4v")
        video = cv2.VideoWriter(str(root / "my_video.mp4"), mp4v, 30, (96, 72))
        for k in range(6):
            video.write(texture(2 * k))
        video.release()
        images(root / "photos", [texture(3 * k) for k in range(3)])
        (root / "photos/depth").mkdir()
        for k in range(3):
            np.save(root / f"photos/depth/{k:02d}.npy", np.full((72, 96), 2.0, np.float32))
        yield root


def test_readme_has_commands():
    assert len(COMMANDS) >= 6 and len(MENTIONED) >= 8


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_readme_runs(line: str, capsys):
    words = shlex.split(line)
    short = SHORT.get(words[0], []) + (OUTPUT if words[0] == "run" else [])
    assert main([*words, *short]) in (0, 3), capsys.readouterr().err


@pytest.mark.parametrize("line", sorted(set(MENTIONED)))
def test_a_mentioned_command_is_known(line: str):
    words = [word.removesuffix("...") for word in shlex.split(line)]
    words, _ = take_settings(words)
    try:
        _, unknown = _parser().parse_known_args(words)
    except SystemExit as ended:
        assert ended.code == 0, line  # help
    else:
        assert unknown == [], line
