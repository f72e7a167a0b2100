"""The command line: help without torch, exit codes, and one sentence for whatever is wrong."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import minislam
from minislam.cli.main import MALLOC, main
from tests.recordings import picture, save, tum_folder, video

pytestmark = pytest.mark.slow

TEXTURE = np.random.default_rng(0).integers(0, 256, (20, 27, 3)).astype(np.uint8)
# What a failed run may leave.
RUN_FILES = {
    "camera.json", "checkpoint.npz", "config.json", "keyframes", "log.txt", "plots", "run.json"
}  # fmt: skip


def texture(shift: int) -> np.ndarray:
    """Return a crop of a blotchy picture, moved by `shift` px: (72, 96, 3) uint8."""
    large = cv2.resize(TEXTURE, (216, 160), interpolation=cv2.INTER_CUBIC)
    return large[20:92, 20 + shift : 116 + shift]


def images(folder: Path, pictures: list[np.ndarray]) -> Path:
    for number, image in enumerate(pictures):
        save(folder / f"{number:02d}.png", image)
    return folder


def run(*arguments: object) -> int:
    return main(["run", "--preset", "test", *map(str, arguments)])


def the_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was said on stderr, which is one line of one sentence besides warnings."""
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("minislam: ")]
    assert len(said) == 1, lines
    assert not any("Traceback" in line for line in lines)
    assert re.match(r"minislam: expected .*[^.]$", said[0]), said[0]
    return said[0]


# Doctor and evaluation


def test_the_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "minislam", "--version"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, f"minislam {minislam.__version__}\n")


def test_doctor_finds_everything(capsys):
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in ("numpy", "torch", "cv2", "matplotlib", "off by 0.0"))


def test_eval_is_reached(tmp_path: Path, capsys):
    rows = "".join(f"{k} {k} {k * k % 5} 0 0 0 0 1\n" for k in range(6))
    (tmp_path / "a.txt").write_text(rows)
    assert main(["eval", str(tmp_path / "a.txt"), str(tmp_path / "a.txt")]) == 0
    assert "rmse\t0.000000" in capsys.readouterr().out


# Errors of the input


def text_named_png(folder: Path) -> Path:
    images(folder, [texture(k) for k in range(3)])
    (folder / "00.png").write_text("this is a text")
    return folder


def truncated_image(folder: Path) -> Path:
    images(folder, [texture(k) for k in range(4)])
    whole = (folder / "02.png").read_bytes()
    (folder / "02.png").write_bytes(whole[: len(whole) // 2])
    return folder


def text_named_mp4(path: Path) -> Path:
    path = path.with_suffix(".mp4")
    path.write_text("no video")
    return path


def half_a_video(path: Path) -> Path:
    path = video(path.with_suffix(".mp4"))
    path.write_bytes(path.read_bytes()[:600])
    return path


def empty_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


def truth_with_nan(folder: Path) -> Path:
    truth = tum_folder(folder) / "groundtruth.txt"
    truth.write_text(truth.read_text().replace("100.200000 2 4", "100.200000 2 nan"))
    return folder


INPUTS: list[tuple[Callable[[Path], Path], str]] = [
    (lambda path: path / "nowhere", "nowhere does not exist"),
    (lambda path: Path("/dev/null"), "/dev/null does not exist or is a device"),
    (empty_folder, "found none; give a folder that holds images"),
    (text_named_png, r"00\.png \(14 bytes\) is of another format"),
    (truncated_image, r"02\.png \(\d+ bytes\) is damaged"),
    (text_named_mp4, r"\(8 bytes\) cannot be opened as one"),
    (half_a_video, r"\(600 bytes\) cannot be opened as one"),
    (truth_with_nan, r"finite numbers in line 4 of .*groundtruth\.txt"),
    (lambda path: images(path, [texture(0)]), "at least two frames.* among 1 "),
    (lambda path: images(path, [0 * texture(0)] * 8), "at least two frames.* among 8 "),
    (lambda path: Path("synth:nothing"), "with NAME one of .*crowd.* found synth:nothing"),
    (lambda path: Path("synth:crowd:-1"), "found synth:crowd:-1"),
]


@pytest.mark.parametrize(("make", "words"), INPUTS)
def test_a_wrong_input_is_one_sentence_and_exit_code_1(make, words: str, tmp_path: Path, capsys):
    source, out = make(tmp_path / "input"), tmp_path / "out"
    assert run(source, "-o", out) == 1
    assert re.search(words, the_sentence(capsys))
    left = {path.name for path in out.iterdir()} if out.exists() else set()
    assert left <= RUN_FILES  # nothing that looks like a result
    assert not list(tmp_path.rglob("*.tmp"))


def test_two_smooth_pictures_do_not_pass_for_a_map(tmp_path: Path, capsys):
    source = images(tmp_path / "input", [picture(k) for k in range(2)])
    assert run(source, "-o", tmp_path / "out") == 3
    assert "the map shows only" in capsys.readouterr().err


def test_a_video_that_is_none_is_one_line_on_the_real_stderr(tmp_path: Path):
    # OpenCV and FFmpeg write to the file descriptor, past what Python can capture.
    command = [sys.executable, "-m", "minislam", "run", str(text_named_mp4(tmp_path / "a"))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("minislam: expected a video")


def test_a_failed_run_says_so_in_run_json(tmp_path: Path, capsys):
    source, out = images(tmp_path / "input", [0 * texture(0)] * 3), tmp_path / "out"
    assert run(source, "-o", out) == 1
    facts = json.loads((out / "run.json").read_text())
    assert facts["exit_code"] == 1 and facts["state"].startswith("failed: expected at least two")
    assert the_sentence(capsys).removeprefix("minislam: ") in facts["state"]


def test_two_frames_are_enough(tmp_path: Path, capsys):
    out = tmp_path / "out"
    assert run(images(tmp_path / "input", [texture(0), texture(3)]), "-o", out) == 0
    poses = (out / "trajectory.txt").read_text().splitlines()
    assert len([row for row in poses if not row.startswith("#")]) == 2
    assert "the focal length is unknown" in capsys.readouterr().err
    assert json.loads((out / "metrics.json").read_text())["ate_all_cm"] is None


# Errors of the output and of the settings


def test_an_output_that_is_a_file_is_refused(tmp_path: Path, capsys):
    (tmp_path / "out").write_text("mine")
    assert run(images(tmp_path / "input", [texture(0)]), "-o", tmp_path / "out") == 1
    assert "is a file; choose another name" in the_sentence(capsys)
    assert (tmp_path / "out").read_text() == "mine"


def test_an_output_that_holds_files_is_refused(tmp_path: Path, capsys):
    save(tmp_path / "out/mine.png", texture(0))
    assert run(images(tmp_path / "input", [texture(0)]), "-o", tmp_path / "out") == 1
    assert "; choose another name or add --overwrite" in the_sentence(capsys)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.png"]


@pytest.mark.parametrize("depth", ["simulated", "sensor:", "files:nowhere", "laser"])
def test_a_wrong_depth_costs_no_earlier_run_its_files(depth: str, tmp_path: Path, capsys):
    save(tmp_path / "out/keyframes/000000_input.png", texture(0))
    source = images(tmp_path / "input", [texture(0), texture(3)])
    assert run(source, "-o", tmp_path / "out", "--overwrite", "--depth", depth) == 1
    the_sentence(capsys)
    assert (tmp_path / "out/keyframes/000000_input.png").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["--preset", "desktop"],
            "a preset among laptop, paper, paper-fast, test, found 'desktop'",
        ),
        (["--tracking.window", "many"], "tracking.window to be of type int like 10, found 'many'"),
        (["--config", "nowhere.json"], "a readable file nowhere.json"),
        (["--stride", "0"], "stride of at least 1 and at most 1e+09, found 0"),
        (["--start", "5"], "at least two frames, found 0 among 2 images of input"),
        (["--fx", "nan"], "fx to be a finite number, found nan"),
        (["--preset", ""], "a preset among laptop"),
        (["--seed", "x"], "seed to be of type int like 0, found 'x'"),
        (["--seed", "-1"], "seed of at least 0"),
        (["--seed", "9" * 23], "seed of at least 0 and at most"),
        (["--threads", "100000"], "threads of at least 1 and at most 256, found 100000"),
        (["--tracking.window", "0"], "tracking.window of at least 1"),
        (["--size", "100000x100000"], "size of at least 16 and at most 16384"),
        (["--fx", "1e300"], "fx of at least 1 and at most 50000"),
        (["--depth", "sensor"], "expected a sensor's depth in input, found none"),
    ],
)
def test_a_wrong_setting_is_one_sentence(arguments: list[str], words: str, tmp_path: Path, capsys):
    source = images(tmp_path / "input", [texture(0), texture(3)])
    assert run(source, "-o", tmp_path / "out", *arguments) == 1
    assert words in the_sentence(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "tree", [{"tracking": {"windw": 3}}, {"tracking.windw": 3}, {"tracking": {"windw": {"a": 3}}}]
)
def test_an_unknown_setting_in_a_file_names_the_nearest(tree: dict, tmp_path: Path, capsys):
    (tmp_path / "settings.json").write_text(json.dumps(tree))
    assert run("synth:crowd", "--config", tmp_path / "settings.json") == 1
    assert "the nearest is tracking.window" in the_sentence(capsys)


def test_another_c_library_has_no_such_settings_of_malloc(monkeypatch: pytest.MonkeyPatch):
    for library in (lambda name: object(), lambda name: len(name)):  # macOS; Windows takes no None
        for name in MALLOC:
            monkeypatch.delenv(f"MALLOC_{name}", raising=False)
        monkeypatch.setattr("ctypes.CDLL", library)
        assert main(["weights", "list"]) == 0
        assert os.environ["MALLOC_ARENA_MAX"] == "1"


@pytest.mark.skipif(sys.platform != "linux", reason="settings of glibc")
def test_freed_memory_stays_in_the_process_and_in_those_that_it_starts():
    text = (
        "import resource, subprocess, sys, numpy; from minislam.cli.main import set_malloc\n"
        "if sys.argv[1] == 'set': set_malloc()\n"
        "def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "before = faults()\n"
        "for _ in range(100): numpy.ones(3 << 17)\n"  # 3 MB: 768 pages
        "print(faults() - before, flush=True)\n"
        "if sys.argv[1] == 'set': subprocess.run([sys.executable, '-c', sys.argv[2], 'inherit'])\n"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}

    def counted(environment: dict[str, str]) -> list[int]:
        command = [sys.executable, "-c", text, "set", text]
        return [
            int(n) for n in subprocess.check_output(command, env=environment, text=True).split()
        ]

    given = {"MALLOC_TRIM_THRESHOLD_": "131072", "MALLOC_MMAP_THRESHOLD_": "131072"}
    returned = counted(plain | given)  # what the user has set stays
    if not any(returned):
        pytest.skip("this system counts no page faults")
    assert max(counted(plain)) < 10_000
    assert min(returned) > 20_000
