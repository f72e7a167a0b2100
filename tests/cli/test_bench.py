"""A bench runs each sequence once, goes on where it ended, and survives a failing sequence."""

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from minislam.cli import bench
from minislam.cli.main import main
from tests.recordings import tum_folder

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the stand-in for Python is a script")
PYTHON = sys.executable

# Instead of `python -m minislam run SEQUENCE -o FOLDER HOW ...`: notes the command, and ends as
# the name of the sequence says.
STAND_IN = """#!{python} -S
import json, pathlib, signal, sys, time
name, folder = pathlib.Path(sys.argv[4]).name, pathlib.Path(sys.argv[6])
with open({calls!r}, "a") as file:
    file.write(json.dumps([name, *sys.argv[7:]]) + "\\n")
folder.mkdir(parents=True, exist_ok=True)
def end(state, code, ate_cm=None):
    (folder / "run.json").write_text(json.dumps({{"state": state, "exit_code": code}}))
    (folder / "metrics.json").write_text(json.dumps({{"ate_all_cm": ate_cm}}))
    sys.exit(code)
if name == "broken":
    end("failed: no memory", 1)
if name == "slow" and "--resume" not in sys.argv:
    (folder / "checkpoint.npz").touch()
    signal.signal(signal.SIGTERM, lambda *_: end("interrupted", 130))
    time.sleep(30)
    sys.exit(9)
end("finished, partly lost" if name == "ball" else "finished", 3 * (name == "ball"), 1.234)
"""


class Bench:
    """Folders of sequences, and a command whose runs take no time."""

    def __init__(self, root: Path) -> None:
        self.data, self.out, self.calls = root / "data", root / "out", root / "calls"
        self.python = root / "python"
        self.python.write_text(STAND_IN.format(python=PYTHON, calls=str(self.calls)))
        self.python.chmod(self.python.stat().st_mode | stat.S_IEXEC)

    def sequence(self, name: str) -> None:
        tum_folder(self.data / name, 2)

    def run(self, *options: str) -> int:
        return main(["bench", str(self.data), "-o", str(self.out), *options])

    def commands(self) -> list[list[str]]:
        text = self.calls.read_text() if self.calls.exists() else ""
        return [json.loads(line) for line in text.splitlines()]


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench(tmp_path)
    monkeypatch.setattr(bench.sys, "executable", str(made.python))
    return made


def test_every_sequence_is_run_and_stands_in_the_tables(made: Bench, capsys):
    for name in ("scene1/ball", "scene1/crowd", "rgbd_bonn_crowd"):
        made.sequence(name)
    assert made.run("--preset", "test", "--stride", "2") == 0
    how = ["--overwrite", "--preset", "test", "--stride", "2"]
    assert made.commands() == [[name, *how] for name in ("rgbd_bonn_crowd", "ball", "crowd")]
    out = capsys.readouterr().out
    assert "| minislam       | Monocular | 1.23* | 1.23  | 1.23  |" in out
    assert "| WildGS-SLAM    | Monocular | 0.2   | 0.3   | 0.25  |" in out
    assert (made.out / "bench.md").read_text() in f"{out}\n"
    assert "\nOptions: --preset test --stride 2\n" in out
    table = (made.out / "bench.csv").read_text().splitlines()
    assert table[:2] == ["Bonn", "ATE [cm],input,Crowd,mean"]
    assert "minislam,Monocular,1.23*,1.23,1.23" in table


def test_the_same_command_again_runs_only_what_is_not_finished(made: Bench):
    made.sequence("ball")
    made.sequence("broken")
    assert made.run() == 1
    made.sequence("crowd")
    assert made.run() == 1
    names = [command[0] for command in made.commands()]
    assert names == ["ball", "broken", "broken", "crowd"]


def test_a_failing_sequence_does_not_end_the_bench(made: Bench, capsys):
    for name in ("broken", "zebra"):
        made.sequence(name)
    assert made.run() == 1
    assert "| minislam | Monocular | F      | 1.23  | -    |" in capsys.readouterr().out


@pytest.mark.slow
def test_an_interrupted_bench_keeps_its_tables_and_goes_on(made: Bench):
    for name in ("ball", "slow"):
        made.sequence(name)
    text = f"import sys; from minislam.cli.main import main; sys.executable = {str(made.python)!r}"
    arguments = ["bench", str(made.data), "-o", str(made.out)]
    command = [PYTHON, "-c", f"{text}; sys.exit(main({arguments!r}))"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for _ in range(300):
            if (made.out / "slow/checkpoint.npz").exists():
                break
            time.sleep(0.1)
        time.sleep(0.3)  # until the stand-in listens
        process.send_signal(signal.SIGTERM)
        out = process.communicate(timeout=60)[0]
    assert process.returncode == 130
    assert "| minislam       | Monocular | 1.23* | 1.23  |" in out
    assert json.loads((made.out / "slow/run.json").read_text())["state"] == "interrupted"
    assert made.run() == 0
    assert made.commands()[2:] == [["slow", "--resume"]]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--strid", "2"], 2, "expected a known option, found --strid; the nearest is --stride"),
        (["--tracking.windw=3"], 2, "found --tracking.windw; the nearest is --tracking.window"),
        (["--stride", "0"], 1, "expected stride of at least 1"),
        (["--seed", "2", "--depth", "laser"], 1, "expected --depth none, simulated"),
        (["--preset", "fast"], 1, "expected a preset among"),
        (["other"], 2, "found also 'other'"),
        (["--resume"], 2, "expected no --resume, found it; leave it out, bench resumes by itself"),
        (["--overwrite"], 2, "expected no --overwrite, found it; leave it out"),
    ],
)
def test_options_of_no_run_are_refused_and_not_kept(made: Bench, capsys, options, code, words):
    made.sequence("ball")
    try:
        assert made.run(*options) == code
    except SystemExit as ended:  # of argparse
        assert ended.code == code
    assert words in capsys.readouterr().err
    assert made.commands() == [] and not made.out.exists()


def test_options_before_the_folders_are_refused(made: Bench, capsys):
    for options in (["-o", str(made.out)], ["--stride", "2"]):
        assert main(["bench", *options, str(made.data)]) == 2
        words = f"found {options[0]}; folders come first, then the options"
        assert words in capsys.readouterr().err


def test_tables_are_of_one_kind_of_run(made: Bench, capsys):
    made.sequence("ball")
    assert made.run("--stride", "2") == 0
    assert made.run("--stride", "3") == 1
    assert "expected the options of the bench in" in capsys.readouterr().err
    assert len(made.commands()) == 1


def test_folders_without_sequences_and_equal_names_are_one_sentence(made: Bench, capsys):
    made.data.mkdir()
    assert made.run() == 1
    assert f"in {made.data}, found none; check the path" in capsys.readouterr().err
    made.sequence("a/crowd")
    made.sequence("b/crowd")
    assert made.run() == 1
    assert "found two called crowd" in capsys.readouterr().err


def test_two_folders_of_one_published_sequence_are_not_one_column(made: Bench, capsys):
    made.sequence("freiburg3_walking_xyz")
    made.sequence("rgbd_dataset_freiburg3_walking_xyz")
    assert made.run() == 1
    assert "found two called rgbd_dataset_freiburg3_walking_xyz; bench" in capsys.readouterr().err


def test_a_synthetic_sequence_is_not_set_beside_the_papers_numbers(made: Bench, capsys):
    made.sequence("crowd")
    (made.data / "crowd" / "synth.json").touch()
    assert made.run() == 0
    out = capsys.readouterr().out
    assert "synthetic-crowd" in out and "WildGS-SLAM" not in out


def test_an_output_that_is_a_file_is_one_sentence(made: Bench, capsys):
    made.sequence("ball")
    made.out.write_text("mine")
    assert made.run() == 1
    assert f"expected an output folder, but {made.out} is a file" in capsys.readouterr().err
    assert made.out.read_text() == "mine"


@pytest.mark.slow
def test_the_command_of_a_run_is_one_that_minislam_knows(tmp_path: Path, capfd):
    folder = tum_folder(tmp_path / "crowd", 2)
    (folder / "rgb/100.000000.png").write_bytes(b"damaged")
    assert main(["bench", str(folder), "-o", str(tmp_path / "out"), "--preset", "test"]) == 1
    said = capfd.readouterr()
    assert "minislam: expected a whole PNG or JPEG image" in said.err
    assert "| minislam       | Monocular | F     | -     |" in said.out
