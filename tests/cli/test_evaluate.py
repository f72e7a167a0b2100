"""`minislam eval`: evo's grammar, evo's printout."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from minislam.cli.evaluate import run_eval
from minislam.cli.main import parsed
from minislam.data.trajectory import write_trajectory
from minislam.errors import InputError
from minislam.geometry.alignment import Similarity
from minislam.records import Trajectory
from tests.helpers import random_transforms

pytestmark = pytest.mark.slow


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """Return truth and an estimate: half the size, turned, and with one pose off."""
    poses = random_transforms(20, "normal", 0).numpy()
    truth = Trajectory(np.arange(20.0), poses)
    turn = random_transforms(1, "normal", 1)[0].numpy()
    moved = Similarity(0.5, turn[:3, :3], turn[:3, 3]).transform_poses(poses)
    moved[4, :3, 3] += 0.1
    names = str(tmp_path / "gt.txt"), str(tmp_path / "est.txt")
    write_trajectory(names[0], truth)
    write_trajectory(names[1], Trajectory(np.arange(20.0), moved))
    return names


def parse(*arguments: str) -> argparse.Namespace:
    return parsed(["eval", *arguments])


# Known answers


@pytest.mark.parametrize(
    "flags, words",
    [
        ([], "(with Sim(3) Umeyama alignment, the default for monocular estimates)"),
        (["-as"], "(with Sim(3) Umeyama alignment)"),
        (["--align"], "(with SE(3) Umeyama alignment)"),
        (["--correct_scale"], "(with scale correction only)"),
        (["--no_align"], "(with no alignment)"),
    ],
)
def test_the_alignment_is_said(files, capsys, flags: list[str], words: str):
    run_eval(parse(*files, *flags))
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["APE w.r.t. translation part (m)", words, ""]


def test_the_table_is_evo_s(files, capsys):
    run_eval(parse(*files))
    rows = capsys.readouterr().out.splitlines()[3:]
    assert [row.split()[0] for row in rows] == "max mean median min rmse sse std".split()
    assert all(re.fullmatch(r" {3,7}[a-z]+\t\d+\.\d{6}", row) for row in rows)


def test_results_and_plot_are_saved_silently(files, tmp_path: Path, capsys):
    plot, results = tmp_path / "plot", tmp_path / "ate.json"
    run_eval(parse(*files, "--silent", "--save_plot", str(plot), "--save_results", str(results)))
    assert capsys.readouterr().out == ""
    assert plot.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    saved = json.loads(results.read_text())
    assert saved["pairs"] == 20 and len(saved["errors"]) == 20
    assert saved["scale"] == pytest.approx(2, rel=0.05)
    assert set(saved["ate_translation"]) == {"max", "mean", "median", "min", "rmse", "sse", "std"}


def test_verbose_names_pairs_and_scale(files, capsys):
    run_eval(parse(*files, "-v"))
    out = capsys.readouterr().out
    assert "20 pairs (20 estimated, 20 true poses)" in out and "scale" in out


def test_relative_errors_are_those_of_a_drift_that_is_known(tmp_path: Path, capsys):
    # Two poses a second; the estimate drifts 1 cm and 0.1 degrees per pose.
    times, steps = np.arange(0, 10, 0.5), np.arange(20)
    truth, estimate = (np.tile(np.eye(4), (20, 1, 1)) for _ in range(2))
    truth[:, 0, 3], estimate[:, 0, 3] = 1.0 * steps, 1.01 * steps
    angles = np.deg2rad(0.1 * steps)
    estimate[:, 1, 1] = estimate[:, 2, 2] = np.cos(angles)  # about x, the direction of travel
    estimate[:, 2, 1], estimate[:, 1, 2] = np.sin(angles), -np.sin(angles)
    names = str(tmp_path / "gt.txt"), str(tmp_path / "est.txt")
    write_trajectory(names[0], Trajectory(times, truth))
    write_trajectory(names[1], Trajectory(times, estimate))
    for flags, over, poses in [
        ([], "1 s (9 motions)", 2),
        (["--delta", "3", "--delta_unit", "f"], "3 f (6 motions)", 3),
    ]:
        results = tmp_path / "rpe.json"
        save = ["--save_results", str(results), "--overwrite"]
        run_eval(parse(*names, "--rpe", "--no_align", *save, *flags))
        out = capsys.readouterr().out
        shift, angle = json.loads(results.read_text())["rpe"].values()
        assert f"RPE w.r.t. translation part (m) over {over}" in out
        assert f"RPE w.r.t. rotation angle (deg) over {over}" in out and "APE" not in out
        assert shift["rmse"] == pytest.approx(0.01 * poses, abs=1e-6)
        assert angle["mean"] == pytest.approx(0.1 * poses, abs=1e-4)


def test_relative_errors_are_those_of_evo(files, tmp_path: Path):
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    truth, estimate = (file_interface.read_tum_trajectory_file(file) for file in files)
    truth, estimate = sync.associate_trajectories(truth, estimate)
    estimate.align(truth, correct_scale=True)
    results = tmp_path / "rpe.json"
    flags = ["--rpe", "--delta", "1", "--delta_unit", "f", "--silent", "--save_results"]
    run_eval(parse(*files, *flags, str(results)))
    found = json.loads(results.read_text())["rpe"].values()
    kinds = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    for kind, statistics in zip(kinds, found, strict=True):
        rpe = metrics.RPE(kind, delta=1, delta_unit=metrics.Unit.frames)
        rpe.process_data((truth, estimate))
        assert statistics["rmse"] == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse))


def test_evo_s_word_for_the_format_and_a_run_folder_are_taken(files, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path / "run", tmp_path / "tum"):
        folder.mkdir()
        (folder / "trajectory.txt").write_text(Path(files[1]).read_text())
    said = []
    truth, estimate = files
    for words in (
        [truth, estimate, "-as"],
        ["tum", truth, estimate, "-as"],
        ["tum", "-as", truth, estimate],
        ["-as", "tum", truth, estimate],
        ["tum", truth, "tum", "-as"],
        ["tum", truth, "-as", estimate],
        [truth, str(tmp_path / "run"), "-as"],
    ):
        run_eval(parse(*words))
        said.append(capsys.readouterr().out)
    assert said == 7 * said[:1]


# Errors


@pytest.mark.parametrize(
    "flags",
    [["--delta", "0"], ["--delta", "nan"], ["--delta", "inf"],
     ["--delta", "1.5", "--delta_unit", "f"], ["--delta", "30"],
     ["--delta", "30", "--delta_unit", "f"]],
)  # fmt: skip
def test_a_motion_of_no_length_of_half_a_frame_or_of_all_is_refused(files, flags: list[str]):
    wanted = "as a whole number of frames, 1 to 19" if "f" in flags else "at most 19 s, the length"
    with pytest.raises(InputError, match=f"expected a --delta .*{wanted}.*; give a value between"):
        run_eval(parse(*files, "--rpe", *flags))


def test_flags_of_rpe_alone_and_a_folder_as_truth_are_refused(files, tmp_path: Path):
    for flags in (["--delta", "2"], ["--delta_unit", "f"]):
        with pytest.raises(InputError, match="found none; add --rpe"):
            run_eval(parse(*files, *flags))
    with pytest.raises(InputError, match="expected a file of true poses first, found the folder"):
        run_eval(parse(str(tmp_path), files[1]))


def test_contradicting_flags_and_strange_clocks(files):
    with pytest.raises(InputError, match="leave one out"):
        run_eval(parse(*files, "-a", "--no_align"))
    with pytest.raises(InputError, match="--t_offset"):
        run_eval(parse(*files, "--t_offset", "1000"))


def test_pairs_that_are_few_by_their_units_or_too_few_to_compare_are_said(tmp_path: Path, capsys):
    poses, times = random_transforms(200, "normal", 0).numpy(), np.arange(200) / 4
    names = [str(tmp_path / name) for name in ("truth.txt", "estimate.txt", "one.txt")]
    write_trajectory(names[0], Trajectory(times * 1e3 / 20, poses))
    write_trajectory(names[1], Trajectory(times, poses))
    run_eval(parse(*names[:2], "--silent"))
    said = capsys.readouterr().err
    assert said.startswith("WARNING: only 4 pairs: check that the times of both are in seconds")
    write_trajectory(names[2], Trajectory(times[:1], poses[:1]))
    run_eval(parse(*names[1:], "--no_align"))
    assert "rmse\t0.000000" in capsys.readouterr().out
    with pytest.raises(InputError, match="expected at least 2 pairs of poses for --rpe, found 1"):
        run_eval(parse(*names[1:], "--no_align", "--rpe"))


def test_poses_that_share_one_true_pose_have_no_motion_in_a_second(tmp_path: Path):
    names = [str(tmp_path / name) for name in ("truth.txt", "estimate.txt")]
    poses = random_transforms(20, "normal", 0).numpy()
    write_trajectory(names[0], Trajectory(np.arange(20.0), poses))
    write_trajectory(names[1], Trajectory(5 + np.arange(10) * 0.03, poses[:10]))
    flags = ["--t_max_diff", "0.6", "--no_align", "--rpe"]
    with pytest.raises(InputError, match=r"different true ones, found one .*smaller --t_max_diff"):
        run_eval(parse(*names, *flags))
    run_eval(parse(*names, *flags, "--delta", "3", "--delta_unit", "f", "--silent"))  # as evo


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--t_offset", "nan"], "expected --t_offset of at least -1e"),
        (["--t_offset=-inf"], "expected --t_offset of at least -1e"),
        (["--t_max_diff", "-1"], "expected --t_max_diff of at least 0"),
        (["--t_max_diff", "nan"], "expected --t_max_diff of at least 0"),
        (["--save_plot", "plot.svg"], r"expected --save_plot FILE\.png, found plot\.svg"),
    ],
)
def test_times_that_are_none_and_pictures_of_other_kinds_are_refused(files, flags, words: str):
    with pytest.raises(InputError, match=words):
        run_eval(parse(*files, *flags))


def test_files_of_the_user_stay(files, tmp_path: Path):
    for name in ("ate.json", "plot.png"):
        (tmp_path / name).write_text("mine")
    for flag, name in (("--save_results", "ate.json"), ("--save_plot", "plot")):
        with pytest.raises(InputError, match=r"but .*(ate\.json|plot\.png) exists; .* --overwrite"):
            run_eval(parse(*files, flag, str(tmp_path / name)))
        for file in files:
            before = Path(file).read_text()
            with pytest.raises(InputError, match="exists and is an input; choose another name"):
                run_eval(parse(*files, flag, file, "--overwrite"))
            assert Path(file).read_text() == before
        run_eval(parse(*files, "--silent", flag, str(tmp_path / name), "--overwrite"))
    assert json.loads((tmp_path / "ate.json").read_text())["pairs"] == 20
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_help_does_not_wait_for_torch():
    program = (
        "import argparse, sys\n"
        "from minislam.cli.evaluate import add_parser\n"
        "add_parser(argparse.ArgumentParser().add_subparsers())\n"
        "assert not {'torch', 'numpy', 'matplotlib'} & set(sys.modules)\n"
    )
    root = str(Path(__file__).parents[2])
    subprocess.run([sys.executable, "-c", program], check=True, cwd=root)
