"""A finished run from its folder alone: the same renderings, poses, beta and frames."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import minislam
from minislam.data.files import write_json
from minislam.data.sequence import open_sequence
from minislam.data.trajectory import write_trajectory
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.flow import STRIDE
from minislam.records import Trajectory
from minislam.runs import loaded
from minislam.tracking.grid import Grid
from minislam.tracking.safeguards import diagnostics
from minislam.tracking.safeguards.rolling_shutter import ImageMotion
from minislam.viz import figures
from tests.runs.finished import finished

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(root: Path) -> minislam.Run:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        done = minislam.run(
            "synth:person", root / "run", preset="test", stride=3, max_frames=10, size=(96, 72),
            settings={"seed": 3, "mapping.init_iterations": 60}, quiet=True,
        )  # fmt: skip
        assert torch.get_num_threads() == 2  # of the caller
    finally:
        torch.set_num_threads(threads)
    return done


def test_every_keyframe_is_rendered_again_within_one_grey_level(run: minislam.Run):
    again = minislam.load(run.folder.path)
    assert len(again.keyframes) >= 4
    for index in again.keyframes:
        file = run.folder.path / f"keyframes/{index:06d}_render.png"
        stored = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        rendered = np.round(255 * again.render(again.poses[index]))
        assert np.abs(rendered - stored).max() <= 1


def test_a_frame_is_plotted_as_bright_as_it_is_exposed(run: minislam.Run, monkeypatch):
    again, shown = minislam.load(run.folder.path), []
    monkeypatch.setattr(loaded, "overview", lambda image, beta, color, *_: shown.append(color))
    index, level = again.keyframes[1], [0.5, 0.5, 0.25]
    again.plot(index)
    again.frames[index] = replace(again.frames[index], exposure=level)
    again.plot(index)
    dark = shown[0] < 1  # brighter ones are cut off
    np.testing.assert_allclose(shown[1][dark], (shown[0] * level)[dark], atol=1e-6)


def test_every_frame_knows_how_bright_it_is_beside_the_map():
    slam = finished()
    slam.tracker.keyframes.frames, slam.tracker.grid = [], slam.tracker.graph.grid
    slam.mapper.exposures = {4: torch.ones(3), 8: torch.tensor([4.0, 1.0, 1.0])}
    slam.mapper.background, slam.mapper.least_weight = torch.zeros(3), 0.0
    slam.sequence.name, slam.sequence.description, slam.sequence.source_name = "a", "", str
    levels = [frame["exposure"] for frame in loaded.scene_of(slam)["frames"]]
    assert len(levels) == 20 and levels[0] == [1, 1, 1]
    np.testing.assert_allclose(levels[6], [2, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(levels[19], [4, 1, 1], rtol=1e-6)
    slam.mapper.exposures = {}
    assert loaded.scene_of(slam)["frames"][6]["exposure"] is None


def test_a_run_is_found_below_the_home_of_the_user(run: minislam.Run, monkeypatch):
    monkeypatch.setenv("HOME", str(run.folder.path.parent))
    assert minislam.load(f"~/{run.folder.path.name}").folder.path == run.folder.path


def test_a_broken_run_maps_the_longest_piece_and_marks_the_break(tmp_path: Path, monkeypatch):
    drawn = []
    monkeypatch.setattr(diagnostics, "find_breaks", lambda _: [diagnostics.Break(3, 3)])
    monkeypatch.setattr(figures, "_draw_path", lambda *args: drawn.append(args[-1]))
    options = {"stride": 3, "max_frames": 20, "size": (96, 72), "preset": "test", "quiet": True}
    run = minislam.run("synth:person", tmp_path / "run", **options)
    run.plot()
    assert drawn == 4 * [[(0.3, 0.3)]]  # two planes, overview.png, plot()
    piece = range(run.keyframes[0], run.keyframes[-1] + 1)
    assert 3 < min(piece) and 14 < max(piece) and list(run.poses) == list(piece)
    shown = {int(path.name[:6]) for path in (tmp_path / "run/keyframes").glob("*_render.png")}
    assert {*run.keyframes} <= shown <= {*piece}
    assert len(run.trajectory) == 20 and "20 of 20 frames with a pose" in repr(run)
    (warning,) = run.warnings_of_breaks
    assert f"the map shows frames {min(piece)} to {max(piece)} alone" in warning
    with pytest.raises(InputError, match=r"a frame of the map, found 2; choose one of run\.poses"):
        run.plot(2)


def test_of_a_piece_in_two_stretches_the_frames_between_them_are_not_shown(
    tmp_path: Path, monkeypatch
):
    monkeypatch.setattr(diagnostics, "find_breaks", lambda _: [diagnostics.Break(3, 3)])
    monkeypatch.setattr(diagnostics, "pieces", lambda *_: [[(0, 3), (7, 9)], [(4, 6)]])
    options = {"stride": 3, "max_frames": 10, "size": (96, 72), "preset": "test", "quiet": True}
    run = minislam.run("synth:person", tmp_path / "run", **options)
    assert list(run.poses) == [0, 1, 2, 3, 7, 8, 9] and not {*run.keyframes} & {4, 5, 6}


def test_frames_timed_in_nanoseconds_find_their_poses(run: minislam.Run, tmp_path: Path):
    again = minislam.load(shutil.copytree(run.folder.path, tmp_path / "copy"))
    stamps = (1403636579763555584 + np.arange(len(again.frames)) * 33333441) * 1e-9  # EuRoC's names
    trajectory = Trajectory(stamps, again.trajectory.T_world_camera)
    write_trajectory(again.folder.path / "trajectory.txt", trajectory)
    scene = json.loads((again.folder.path / "camera.json").read_text(encoding="utf-8"))
    for frame, stamp in zip(scene["frames"], stamps.tolist(), strict=True):
        frame["timestamp"] = stamp
    write_json(again.folder.path / "camera.json", scene)
    assert list(minislam.load(again.folder.path).poses) == list(run.poses)


def test_depth_is_that_of_the_surface_and_a_camera_can_be_given(run: minislam.Run):
    pose = run.poses[run.keyframes[0]]
    depth = run.render_depth(pose)
    assert 1 < np.median(depth[depth > 0]) < 10  # metres in a room
    small = run.camera.resized(48, 36)
    assert run.render(pose, small).shape == (36, 48, 3)
    assert isinstance(small, Camera)


def test_frames_know_their_source(run: minislam.Run):
    assert [frame.index for frame in run.frames] == list(range(10))
    assert run.frames[1].source == "0.100000.png" and run.frames[1].timestamp == 0.1
    assert set(run.poses) == {frame.index for frame in run.frames}
    assert run.unit == "m"
    options = minislam.InputOptions(stride=3, max_frames=10, size=(96, 72))
    np.testing.assert_array_equal(
        run.sequence.frame(4).image,
        open_sequence("synth:person", options).frame(4).image,
    )


def test_beta_is_larger_on_the_person_than_elsewhere(run: minislam.Run):
    truth = run.sequence.ground_truth
    assert truth is not None
    index = run.keyframes[-1]
    moving, beta = truth.moving_mask(index), run.beta(index)
    assert moving is not None and beta.shape == moving.shape
    assert np.median(beta[moving]) > np.median(beta[~moving])
    for wrong in (10, -1):
        with pytest.raises(InputError, match=f"a frame of the run, 0 to 9, found {wrong}; choose"):
            run.beta(wrong)


def test_how_far_a_rolling_shutter_displaces_a_frame_is_measured_again(run: minislam.Run):
    again, facts = minislam.load(run.folder.path), run.folder.read_run()
    readout = (0.0, 0.05)
    again.folder.read_run = lambda: facts | {"readout_seconds": list(readout)}
    tracked = ImageMotion(Grid.of(run.camera, STRIDE))
    for index in range(6):
        tracked.see(run.sequence.frame(index))
    moved = again.displacement(4)
    assert moved is not None and moved.shape == (run.camera.height, run.camera.width, 2)
    np.testing.assert_array_equal(moved, tracked.displacement(4, readout))
    readout = (0.0, 0.0)  # a global shutter
    assert again.displacement(4) is None


def test_what_a_notebook_shows(run: minislam.Run):
    shown = run._repr_html_()
    assert "person-0" in shown and "data:image/png;base64," in shown
    assert "10 of 10 frames with a pose" in repr(run)
    assert "frames followed" in shown and run.summary()[0].verdict == "good"
    assert len(run.plot(run.keyframes[0]).axes) == 4
    with pytest.raises(InputError, match="expected a frame of the map, found 77"):
        run.plot(77)


def test_a_damaged_or_missing_camera_is_said(run: minislam.Run, tmp_path: Path):
    (tmp_path := tmp_path / "my run").mkdir()
    with pytest.raises(InputError, match=r"expected a run with a map.*of a finished run$"):
        minislam.load(tmp_path)
    write_json(tmp_path / "config.json", {})
    with pytest.raises(InputError, match=r"or repeat it: minislam run --config '.*config.json'$"):
        minislam.load(tmp_path)
    (tmp_path / "checkpoint.npz").touch()
    with pytest.raises(InputError, match=r"json; go on with: minislam run --resume -o .*$"):
        minislam.load(tmp_path)
    write_json(tmp_path / "camera.json", {"camera": 3})
    with pytest.raises(InputError, match=r"expected camera\.json of a run"):
        minislam.load(tmp_path)


def poses_that_are_none() -> list[object]:
    nan, mirror, shear = np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(4)
    nan[0, 3], shear[0, 1] = np.nan, 0.1
    moved = np.eye(4)
    moved[3, 0] = 1.0  # transposed
    return [np.eye(3), 4, None, "pose", [[1], [1, 2]], nan, np.full((4, 4), np.inf), 2 * np.eye(4),
            mirror, shear, moved, np.eye(4)[None], torch.eye(4, requires_grad=True)]  # fmt: skip


@pytest.mark.parametrize("pose", poses_that_are_none(), ids=str)
def test_what_is_no_pose_is_refused(run: minislam.Run, pose: object):
    for render in (run.render, run.render_depth):
        with pytest.raises(
            InputError, match=r"expected T_world_camera \(4, 4\), a rotation .* give"
        ):
            render(pose)


def test_a_run_of_a_version_with_other_settings_is_read(run: minislam.Run, tmp_path: Path):
    folder = Path(shutil.copytree(run.folder.path, tmp_path / "old"))
    tree = run.folder.read_config()
    tree["tracking"]["of_an_older_version"] = 15
    write_json(folder / "config.json", tree)
    assert minislam.load(folder).config == run.config


def test_a_source_with_fewer_frames_is_said(run: minislam.Run, root: Path, tmp_path: Path):
    for name in ("camera.json", "config.json", "trajectory.txt", "map.ply"):
        (tmp_path / name).write_bytes((run.folder.path / name).read_bytes())
    config = json.loads((tmp_path / "config.json").read_text())
    config["input"]["max_frames"] = 8
    write_json(tmp_path / "config.json", config)
    with pytest.raises(InputError, match="expected the 10 frames of the run"):
        _ = minislam.load(tmp_path).sequence
    config["input"] |= {"max_frames": 10, "start": 1}
    write_json(tmp_path / "config.json", config)
    with pytest.raises(InputError, match=r"expected 0\.000000\.png as frame 0 of the run .* found"):
        _ = minislam.load(tmp_path).sequence


def test_options_are_converted_or_refused_before_anything_is_lost(run: minislam.Run, root: Path):
    kept = sorted(run.folder.path.iterdir())
    for wrong in ({"size": "80x60"}, {"stride": "two"}, {"fx": "wide"}, {"max_frames": 2.5}):
        with pytest.raises(InputError, match="expected"):
            minislam.run("synth:person", root / "run", overwrite=True, **wrong)
    with pytest.raises(InputError, match="expected a readable file"):
        minislam.run("synth:person", root / "run", overwrite=True, calibration=root / "none.txt")
    assert sorted(run.folder.path.iterdir()) == kept


def test_unknown_options_and_outputs_in_use_are_refused(run: minislam.Run):
    with pytest.raises(InputError, match="found strid; the nearest is stride"):
        minislam.run("synth:person", strid=3)
    with pytest.raises(InputError, match=r"found seed; it is a setting: settings=\{'seed': 3\}"):
        minislam.run("synth:person", seed=3)
    with pytest.raises(InputError, match=r"found resume; see help\(minislam\.run\)"):
        minislam.run("synth:person", resume=True)
    with pytest.raises(InputError, match="expected a new or empty output folder"):
        minislam.run("synth:person", run.folder.path, max_frames=4, size=(96, 72), preset="test")
