"""Image folders: order, timestamps, names."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.sources import folder_name, read_image_folder
from minislam.errors import InputError
from tests.recordings import picture, save

# Known answers


@pytest.mark.parametrize("inner", ["", "images", "rgb"])
def test_images_in_natural_order_counted_at_thirty_hertz(tmp_path: Path, inner: str):
    for number in (10, 9, 1):
        save(tmp_path / inner / f"frame{number}.jpg", picture(number))
    save(tmp_path / inner / ".frame0.jpg", picture(0))
    recording = read_image_folder(tmp_path)
    assert [path.name for path in recording.images.paths] == [f"frame{n}.jpg" for n in (1, 9, 10)]
    np.testing.assert_allclose(recording.timestamps, [0, 1 / 30, 2 / 30])
    assert "counted at 30" in recording.notes[0]


def test_numeric_names_are_the_timestamps(tmp_path: Path):
    for name in ("7.50.png", "12.PNG".lower(), "101.jpeg"):
        save(tmp_path / name, picture(0))
    np.testing.assert_array_equal(read_image_folder(tmp_path).timestamps, [7.5, 12, 101])


def test_times_with_unequal_decimals_are_in_their_order(tmp_path: Path):
    for name in ("0.1", "0.15", "0.2", "0.25"):
        save(tmp_path / f"{name}.png", picture(0))
    np.testing.assert_array_equal(read_image_folder(tmp_path).timestamps, [0.1, 0.15, 0.2, 0.25])


@pytest.mark.parametrize(
    "unit, per_second", [("ms", 10**3), ("us", 10**6), ("ns", 10**9), ("s", 1)]
)
def test_times_since_1970_are_in_the_unit_of_their_digits(
    tmp_path: Path, unit: str, per_second: int
):
    for second in (1403636579, 1403636581):
        save(tmp_path / f"{second * per_second}.png", picture(0))
    recording = read_image_folder(tmp_path)
    np.testing.assert_array_equal(recording.timestamps, [1403636579, 1403636581])
    assert recording.notes == [f"timestamps [{unit}] from the file names"]


@pytest.mark.parametrize(
    "names",
    ["0 1 2 9", "00020 00022 00028", "10 15 20", "0 33 67", "5 900000 1800000", "1.0 2.0", "7"],
)
def test_whole_numbers_count_images_unless_a_truth_has_them_as_times(tmp_path: Path, names: str):
    for name in names.split():
        save(tmp_path / f"images/{name}.png", picture(0))
    numbers = np.array(list(map(float, names.split())))
    is_counted = "67" not in names and "900000" not in names and "." not in names
    found = read_image_folder(tmp_path)
    np.testing.assert_allclose(found.timestamps, numbers / 30 if is_counted else numbers)
    assert ("counted at 30" in found.notes[0]) is is_counted
    (tmp_path / "groundtruth.txt").touch()
    np.testing.assert_array_equal(read_image_folder(tmp_path).timestamps, numbers)


def test_a_calibration_beside_the_images_is_used(tmp_path: Path):
    save(tmp_path / "images/a.png", picture(0))
    (tmp_path / "calibration.txt").write_text("50 50 20 16")
    assert read_image_folder(tmp_path).calibration.fx == 50


@pytest.mark.parametrize(
    "path, name", [("a/my video", "my_video"), ("x/..hidden", "hidden"), ("x/é 1.5", "é_1.5")]
)
def test_names_can_be_used_for_folders(path: str, name: str):
    assert folder_name(Path(path)) == name


# Errors


def test_an_empty_folder_is_refused_and_the_likely_mistake_named(tmp_path: Path):
    with pytest.raises(InputError, match="found none"):
        read_image_folder(tmp_path)
    (tmp_path / "clip").mkdir()
    with pytest.raises(InputError, match=r"perhaps you mean .*clip"):
        read_image_folder(tmp_path)
    (tmp_path / "walk.MP4").write_bytes(b"")
    with pytest.raises(InputError, match=r"give the video itself, .*walk\.MP4"):
        read_image_folder(tmp_path)


def test_pictures_of_another_kind_are_counted(tmp_path: Path):
    for name in ("a.HEIC", "b.heic", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"found 2 \.heic; convert them to JPEG or PNG"):
        read_image_folder(tmp_path)


def test_the_folder_of_a_run_is_known(tmp_path: Path):
    (tmp_path / "keyframes").mkdir()
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(InputError, match=r"the folder of a run; .* --config .*config\.json"):
        read_image_folder(tmp_path)


def test_two_files_with_one_stamp_are_refused(tmp_path: Path):
    save(tmp_path / "01.png", picture(0))
    save(tmp_path / "1.png", picture(0))
    with pytest.raises(InputError, match=r"1\.0 s of .*1\.png before 1\.0 s of .*1\.png"):
        read_image_folder(tmp_path)
