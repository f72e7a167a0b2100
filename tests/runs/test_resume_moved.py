"""What is said of a run that was interrupted without a map, and of its source that has moved."""

from pathlib import Path

import numpy as np
import pytest

import minislam
from minislam.cli.main import main
from minislam.data.checkpoint import read_checkpoint
from minislam.errors import InputError
from tests.cli.test_main import images, texture
from tests.recordings import save
from tests.runs.test_resume import TRACKING, assert_one_sentence, ctrl_c, run_until

pytestmark = pytest.mark.slow


def test_a_source_that_has_moved_is_found_again_with_config_json(tmp_path: Path, capsys):
    source, out = images(tmp_path / "photos", [texture(k) for k in range(27)]), tmp_path / "out"
    moved = tmp_path / "elsewhere" / "photos"
    assert run_until(ctrl_c, TRACKING, 3, source, out) == 130
    said = capsys.readouterr().err.splitlines()
    assert "stopping after this step; Ctrl-C again stops at once" in said
    assert said[-1] == f"minislam: interrupted; go on with: minislam run --resume -o {out}"
    assert said[-1] in (out / "log.txt").read_text().splitlines()[-1]
    with pytest.raises(InputError, match=rf"no camera\.json; go on with: .* --resume -o {out}$"):
        minislam.load(out)

    moved.parent.mkdir()
    source.rename(moved)
    assert main(["run", "--resume", "-o", str(out)]) == 1
    words = f"but {source} does not exist .*; check the path, move it back, or correct sequence"
    assert_one_sentence(words, capsys)
    config = (out / "config.json").read_text()
    (out / "config.json").write_text(config.replace(str(source), str(moved)))
    assert run_until(ctrl_c, TRACKING, 4, moved, out, "--resume") == 130
    assert read_checkpoint(out / "checkpoint.npz")["slam"]["steps"]["_done"] == {TRACKING: 4}


def test_files_named_from_one_folder_are_found_from_another(tmp_path: Path, monkeypatch):
    source, out = images(tmp_path / "photos", [texture(k) for k in range(27)]), tmp_path / "out"
    (tmp_path / "lens.txt").write_text("80 80 47.5 35.5\n")
    for number in range(27):
        save(tmp_path / f"masks/{number:05d}.png", np.zeros((72, 96), np.uint8))
    for number in range(9):  # by the frames of the run, which takes every third image
        save(tmp_path / f"made/depth/{number:05d}.png", np.full((72, 96), 9000, np.uint16))
    files = "--calibration lens.txt --masks files:masks --depth files:made".split()
    monkeypatch.chdir(tmp_path)
    assert run_until(ctrl_c, TRACKING, 3, source, out, *files) == 130
    assert run_until(ctrl_c, TRACKING, 4, source, out, *files, "--resume") == 130
    (tmp_path / "else/where").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "else/where")
    assert main(["run", "--resume", "-o", str(out)]) in (0, 3)
    done = minislam.load(out)
    assert done.beta(2).shape == (72, 96) and done.sequence.camera.fx == 80
