"""TUM RGB-D folders and the extras of a synthetic sequence."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.tum import is_tum_folder, read_tum_folder
from minislam.errors import InputError
from tests.recordings import picture, save, tum_folder

# Known answers


def test_everything_in_the_folder_is_found(tmp_path: Path):
    recording = read_tum_folder(tum_folder(tmp_path / "my run"))
    assert recording.name == "my_run"
    np.testing.assert_allclose(recording.timestamps, 100 + np.arange(6) / 10)
    stems = [recording.depth_paths[index].stem for index in range(6)]
    assert stems == [f"100.{n}00000" for n in range(6)]
    assert len(recording.mask_paths) == len(recording.static_paths) == 6
    assert len(recording.trajectory) == 6 and len(recording.novel_views) == 2
    assert recording.calibration.fx == 40


def test_a_folder_without_lists_is_recognised_by_its_stamps(tmp_path: Path):
    for number in range(3):
        save(tmp_path / f"rgb/13.{number}50.png", picture(number))
    assert is_tum_folder(tmp_path)
    np.testing.assert_allclose(read_tum_folder(tmp_path).timestamps, [13.05, 13.15, 13.25])


def test_frame_numbers_are_not_stamps(tmp_path: Path):
    save(tmp_path / "rgb/00001.png", picture(0))
    assert not is_tum_folder(tmp_path)
    save(tmp_path / "rgb/2.5.png", picture(0))
    assert not is_tum_folder(tmp_path)


def test_depth_is_associated_by_nearest_stamp(tmp_path: Path):
    tum_folder(tmp_path)
    near, far = "depth/100.000000.png", "depth/100.300000.png"
    (tmp_path / "depth.txt").write_text(f"100.015 {near}\n100.33 {far}\n")
    paths = read_tum_folder(tmp_path).depth_paths
    assert paths == {0: tmp_path / near}


def test_without_a_list_depth_is_found_by_the_names_of_the_images_or_by_stamp(tmp_path: Path):
    for number in range(3):
        save(tmp_path / f"rgb/{number}.png", picture(number))
        save(tmp_path / f"depth/{number}.png", picture(number)[..., 0])
    (tmp_path / "rgb.txt").write_text("1 rgb/0.png\n2 rgb/1.png\n3 rgb/2.png\n")
    stems = {index: path.stem for index, path in read_tum_folder(tmp_path).depth_paths.items()}
    assert stems == {0: "0", 1: "1", 2: "2"}
    (tmp_path / "depth/0.png").rename(tmp_path / "depth/3.01.png")  # now most are near in time
    stems = {index: path.stem for index, path in read_tum_folder(tmp_path).depth_paths.items()}
    assert stems == {0: "1", 1: "2", 2: "3.01"}


@pytest.mark.parametrize("where", ["README.md", "rgb.txt", "folder"])
def test_the_camera_is_known_by_name(tmp_path: Path, where: str):
    name = "rgbd_freiburg2_xyz" if where == "folder" else "desk"
    folder = tum_folder(tmp_path / name, size=(64, 48))
    (folder / "calibration.txt").unlink()
    if where == "README.md":
        (folder / "README.md").write_text("\nTUM fr2_desk\n")
    if where == "rgb.txt":
        text = (folder / "rgb.txt").read_text()
        (folder / "rgb.txt").write_text("# file: 'rgbd_dataset_freiburg2_desk.bag'\n" + text)
    assert read_tum_folder(folder).calibration.fx == 520.9


def test_a_name_alone_does_not_make_another_camera_s_images_wrong(tmp_path: Path):
    folder = tum_folder(tmp_path / "copy_of_fr1", size=(64, 36))
    (folder / "calibration.txt").unlink()
    assert read_tum_folder(folder).calibration is None


def test_names_with_spaces_percent_and_unicode(tmp_path: Path):
    folder = tmp_path / "日本 50% à"
    save(folder / "rgb/le chat 1.png", picture(1))
    (folder / "rgb.txt").write_text("1.5 rgb/le chat 1.png\n", encoding="utf-8")
    recording = read_tum_folder(folder)
    assert recording.images.read(0).shape == (32, 48, 3)
    assert recording.name == "日本_50_à"


# Errors


@pytest.mark.parametrize(
    "text, message",
    [
        ("1.0\n", "timestamp filename.*line 1 of .*rgb.txt, found no file "),
        ("one a.png\n", "finite numbers in line 1"),
        ("nan a.png\n", "finite numbers in line 1"),
        ("1 a.png\n\n1 b.png\n", "increase.*1.0 s of .*a.png before 1.0 s of .*b.png"),
        ("2 a.png\n1 b.png\n", "increase.*2.0 s of .*a.png before 1.0 s of .*b.png"),
    ],
)
def test_wrong_lists_name_the_line_or_the_image(text: str, message: str, tmp_path: Path):
    save(tmp_path / "a.png", picture(1))
    save(tmp_path / "b.png", picture(2))
    (tmp_path / "rgb.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_tum_folder(tmp_path)


def test_a_missing_image_is_named(tmp_path: Path):
    folder = tum_folder(tmp_path)
    (folder / "rgb/100.200000.png").unlink()
    with pytest.raises(InputError, match=r"no file .*100\.200000\.png; "):
        read_tum_folder(folder)


def test_a_name_that_is_too_long_is_a_missing_image(tmp_path: Path):
    (tmp_path / "rgb.txt").write_text("1 " + "a" * 5000)
    with pytest.raises(InputError, match=r"no file .*aaa; "):
        read_tum_folder(tmp_path)


def test_an_empty_list_is_refused(tmp_path: Path):
    (tmp_path / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="found none"):
        read_tum_folder(tmp_path)


def test_wrong_ground_truth_names_file_and_line(tmp_path: Path):
    folder = tum_folder(tmp_path)
    with open(folder / "groundtruth.txt", "a") as file:
        file.write("200 nan 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"line 8 of .*groundtruth\.txt"):
        read_tum_folder(folder)


def test_a_novel_pose_without_image_is_refused(tmp_path: Path):
    folder = tum_folder(tmp_path)
    (folder / "novel/1.png").unlink()
    with pytest.raises(InputError, match="index 1"):
        read_tum_folder(folder)
