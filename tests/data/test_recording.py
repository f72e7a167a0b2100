"""What lies beside a recording: which of it is truth, and the truth at the working size."""

from pathlib import Path

import numpy as np

from minislam.data import InputOptions, open_sequence
from minislam.data.recording import path_of
from minislam.data.tum import read_tum_folder
from tests.recordings import picture, tum_folder

# Known answers


def test_the_truth_of_a_frame_is_that_of_its_image_in_the_recording(tmp_path: Path):
    truth = open_sequence(str(tum_folder(tmp_path)), InputOptions(start=1)).ground_truth
    assert truth.moving_mask(1)[:, :24].all() and not truth.moving_mask(1)[:, 24:].any()
    np.testing.assert_allclose(truth.depth(1), np.float32(5002 / 5000))
    np.testing.assert_allclose(truth.static_image(1), picture(20) / 255, atol=1e-6)
    views = truth.novel_views()
    assert views[1][0][1, 3] == 1 and views[1][1].shape == (32, 48, 3)


def test_the_truth_has_the_working_size(tmp_path: Path):
    truth = open_sequence(str(tum_folder(tmp_path)), InputOptions(size=(20, 17))).ground_truth
    assert truth.moving_mask(0).shape == truth.depth(0).shape == (17, 20)
    assert truth.static_image(0).shape == truth.novel_views()[0][1].shape == (17, 20, 3)


# Degenerate input


def test_depth_alone_is_an_input_and_no_truth(tmp_path: Path):
    folder = tum_folder(tmp_path)
    assert read_tum_folder(folder).has_truth()
    (folder / "groundtruth.txt").unlink()
    for name in ("masks", "static", "novel"):
        (folder / name).rename(tmp_path / f"without_{name}")
    recording = read_tum_folder(folder)
    assert recording.depth_paths and not recording.has_truth()
    assert open_sequence(str(folder)).ground_truth is None


def test_an_image_without_a_file_has_none():
    assert path_of([], 3) is None
    assert path_of([None, Path("1.png")], 0) is None
    assert path_of([None, Path("1.png")], 1) == Path("1.png")
