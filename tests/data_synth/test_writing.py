"""The folder on disk: layout, values, caching, refusal, and the command line."""

import io
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth import SynthError, cached_sequence, generate, write_sequence, writing
from data_synth.cli import main

pytestmark = pytest.mark.slow

FRAMES, SIZE = 3, (64, 48)
STAMPS = ["0.000000", "0.033333", "0.066667"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_sequence("ball", 4, FRAMES, SIZE, tmp_path_factory.mktemp("synth") / "ball")


@pytest.fixture(scope="module")
def truth():
    return generate("ball", 4, FRAMES, SIZE)


def rows(path):
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def test_the_folder_has_the_layout_of_tum(folder):
    for kind in ("rgb", "depth", "masks", "static"):
        assert sorted(path.stem for path in (folder / kind).iterdir()) == STAMPS
    assert rows(folder / "rgb.txt") == [[stamp, f"rgb/{stamp}.png"] for stamp in STAMPS]
    assert rows(folder / "depth.txt") == [[stamp, f"depth/{stamp}.png"] for stamp in STAMPS]
    assert len(rows(folder / "novel" / "poses.txt")) == len(list((folder / "novel").glob("*.png")))
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        assert len([line for line in open(folder / name) if line.startswith("#")]) == 3


def test_images_come_back_as_they_were_generated(folder, truth):
    for index, stamp in enumerate(STAMPS):
        rgb = cv2.imread(str(folder / "rgb" / f"{stamp}.png"))[..., ::-1]
        np.testing.assert_array_equal(rgb.astype(np.float32) / 255, truth.rgb[index])
        static = cv2.imread(str(folder / "static" / f"{stamp}.png"))[..., ::-1]
        np.testing.assert_array_equal(static.astype(np.float32) / 255, truth.static_rgb[index])
        mask = cv2.imread(str(folder / "masks" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, truth.masks[index] * 255)
        depth = cv2.imread(str(folder / "depth" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 5000, truth.depth[index], atol=1.01e-4)


@pytest.mark.parametrize(
    ("file", "poses"),
    [("groundtruth.txt", "T_world_camera"), ("novel/poses.txt", "novel_T_world_camera")],
)
def test_poses_come_back_as_they_were_generated(folder, truth, file, poses):
    expected = getattr(truth, poses)
    table = np.array(rows(folder / file), float)
    assert len(table) == len(expected)
    np.testing.assert_allclose(table[:, 1:4], expected[:, :3, 3], atol=1e-8)
    rotations = Rotation.from_quat(table[:, 4:]).as_matrix()
    np.testing.assert_allclose(rotations, expected[:, :3, :3], atol=1e-7)


def test_the_calibration_is_one_line_of_eleven_numbers(folder, truth):
    (line,) = rows(folder / "calibration.txt")
    camera = truth.intrinsics
    expected = [camera.fx, camera.fy, camera.cx, camera.cy, *SIZE, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(np.array(line, float), expected, rtol=1e-8)


def test_two_runs_write_the_same_bytes(folder, tmp_path):
    again = write_sequence("ball", 4, FRAMES, SIZE, tmp_path / "again")
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for file in files:
        assert (folder / file).read_bytes() == (again / file).read_bytes(), file


def test_no_file_is_written_by_its_name_in_opencv(tmp_path, monkeypatch):
    monkeypatch.delattr(cv2, "imwrite")
    folder = write_sequence("static", 0, 1, SIZE, tmp_path / "Jürgen")
    assert len(list(folder.rglob("*.png"))) > 4


def test_a_complete_folder_is_kept(folder):
    before = (folder / "rgb.txt").stat().st_mtime_ns
    write_sequence("ball", 4, FRAMES, SIZE, folder)
    assert (folder / "rgb.txt").stat().st_mtime_ns == before


def test_a_folder_of_an_older_generator_is_written_anew(tmp_path):
    target = write_sequence("static", 0, 1, SIZE, tmp_path / "old")
    record = json.loads((target / "synth.json").read_text())
    (target / "synth.json").write_text(json.dumps({**record, "generator_version": 0}))
    (target / "rgb.txt").write_text("stale")
    write_sequence("static", 0, 1, SIZE, target)
    assert "stale" not in (target / "rgb.txt").read_text()


def test_foreign_content_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("three years")
    with pytest.raises(SynthError, match="holds other files"):
        write_sequence("ball", 0, 1, SIZE, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_link_to_an_empty_folder_stays_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    write_sequence("static", 0, 1, (24, 16), tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk" / "rgb.txt").exists()


def test_the_folder_one_is_in_is_refused_before_anything_is_rendered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SynthError, match="the folder you are in"):
        write_sequence("static", 0, 1, SIZE, ".", lambda done, total: pytest.fail("rendered"))
    assert not list(tmp_path.iterdir())


def test_another_sequence_is_not_overwritten(folder):
    with pytest.raises(SynthError, match=r"holds the sequence 'ball' with seed 4"):
        write_sequence("ball", 5, FRAMES, SIZE, folder)


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing, "_write_lists", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_sequence("static", 0, 1, SIZE, tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_the_cache_follows_its_environment_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    calls = []
    arguments = ("static", 1, 1, SIZE, lambda done, total: calls.append((done, total)))
    found = cached_sequence(*arguments)
    assert found == tmp_path / "synth" / "static-1-1-64x48"
    assert (found / "groundtruth.txt").exists()
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))  # Windows
    monkeypatch.setenv("MINISLAM_CACHE", "~")
    assert cached_sequence(*arguments) == found
    assert calls == [(1, 1)]  # the second call rendered nothing


def test_without_a_home_the_cache_must_be_named(monkeypatch):
    monkeypatch.delenv("MINISLAM_CACHE", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # nobody's process has no home
    with pytest.raises(SynthError, match=r"no home folder for ~"):
        cached_sequence("static", 1, 1, SIZE)


def test_the_command_lists_the_sequences(capsys):
    assert main(["--list"]) == 0
    assert "umbrella" in capsys.readouterr().out


def test_the_command_writes_a_folder_and_plain_progress(tmp_path, capsys):
    arguments = ["static", "--out", str(tmp_path / "s"), "--frames", "2", "--size", "48x36"]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert str(tmp_path / "s") in printed.out
    assert "100 % (2 of 2 frames)" in printed.err
    assert cv2.imread(str(tmp_path / "s" / "rgb" / "0.000000.png")).shape == (36, 48, 3)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["parade"], "no sequence is called 'parade'"),
        (["crowd", "--size", "big"], "--size is width x height"),
        (["crowd", "--frames", "0"], "at least 1 frame"),
        (["crowd", "--seed", "-3"], "a seed is a whole number"),
    ],
)
def test_known_errors_are_one_sentence_and_exit_code_1(arguments, sentence, tmp_path, capsys):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert sentence in printed.err and printed.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_link_that_leads_to_itself_is_refused_in_a_sentence(tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    assert main(["static", "--frames", "1", "--size", "24x16", "--out", f"{tmp_path}/loop"]) == 1
    assert "could not write" in capsys.readouterr().err


def test_an_error_of_the_system_without_a_text_of_its_own_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(writing, "_put_in_place", lambda *_: shutil.rmtree(tmp_path / "link"))
    (tmp_path / "link").symlink_to(tmp_path)
    assert main(["static", "--frames", "1", "--size", "24x16", "--out", str(tmp_path / "a")]) == 1
    assert "symbolic link" in capsys.readouterr().err


def test_streams_that_cannot_print_do_not_end_the_command(tmp_path, monkeypatch):
    letters = io.TextIOWrapper(io.BytesIO(), "ascii")
    full = io.TextIOWrapper(open("/dev/full", "wb", buffering=0), write_through=True)
    for number, streams in enumerate([(letters, letters), (None, None), (full, full)]):
        out = tmp_path / f"wörk{number}"
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", streams[0])
            patch.setattr(sys, "stderr", streams[1])
            arguments = ["static", "--frames", "1", "--size", "24x16", "--out", str(out)]
            assert main(arguments) == 0 and (out / "synth.json").exists()
    assert b"rk0\n" in letters.buffer.getvalue()


def test_a_scheduler_that_ends_the_command_leaves_nothing(tmp_path, monkeypatch, capsys):
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    monkeypatch.setattr(writing, "_write_lists", lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        assert main(["static", "--frames", "1", "--size", "24x16", "--out", f"{tmp_path}/a"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "nothing was written" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_missing_name_or_folder_is_a_usage_error():
    with pytest.raises(SystemExit) as stopped:
        main(["crowd"])
    assert stopped.value.code == 2


def test_what_a_killed_process_left_in_the_cache_is_removed_after_a_day(tmp_path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    old, new = (tmp_path / f"synth/.ball-9-60-96x72-{name}" for name in ("_r8tpw0q", "abcdefgh"))
    for folder in (old, new):
        (folder / "rgb").mkdir(parents=True)
    os.utime(old, (0, 0))
    cached_sequence("ball", 0, 1, (32, 24))
    assert new.exists() and not old.exists()


def test_a_scratch_folder_that_another_process_renames_meanwhile_is_no_obstacle(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(Path, "glob", lambda *_: [tmp_path / "synth/.ball-0-1-32x24-renamed_"])
    assert (cached_sequence("ball", 0, 1, (32, 24)) / "rgb.txt").exists()
