"""What is said of a run that was interrupted without a map, and of its source that has moved."""

from pathlib import Path

import pytest

import minislam
from minislam.cli.main import main
from minislam.data.run_folder import RunFolder
from minislam.errors import InputError
from tests.cli.test_main import images, texture
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
    assert RunFolder(out).read_checkpoint()["slam"]["steps"]["_done"] == {TRACKING: 4}
