"""open_sequence: what is found, which frames are chosen, where the camera comes from."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from minislam.geometry import Camera
from tests.data.test_metadata import exif
from tests.recordings import picture, save, tum_folder, video

pytestmark = pytest.mark.slow

# Known answers


def test_a_tum_folder_with_all_extras(tmp_path: Path):
    sequence = open_sequence(str(tum_folder(tmp_path / "desk")))
    assert len(sequence) == 6 and sequence.name == "desk" and sequence.warnings == []
    assert sequence.camera == Camera(40, 41, 23, 16, 48, 32)
    assert sequence.description == (
        "TUM RGB-D folder: 6 of 6 images, 6 depth, ground truth 0.5 s, 48x32 -> 48x32 px, "
        "calibration.txt"
    )
    frame = sequence.frame(2)
    np.testing.assert_array_equal(frame.image.numpy(), picture(2).astype(np.float32) / 255)


def test_start_and_stride_keep_the_timestamps_of_the_source(tmp_path: Path):
    options = InputOptions(start=1, stride=2, max_frames=2)
    sequence = open_sequence(str(tum_folder(tmp_path)), options)
    frames = list(sequence)
    assert [frame.frame_index for frame in frames] == [0, 1]
    np.testing.assert_allclose([frame.timestamp for frame in frames], [100.1, 100.3])
    np.testing.assert_allclose(sequence.sensor_depth(1), np.float32(5003 / 5000))


def test_a_video_keeps_the_time_of_skipped_frames(tmp_path: Path):
    options = InputOptions(start=2, stride=3, max_frames=3)
    sequence = open_sequence(str(video(tmp_path / "v.mp4", rate=10)), options)
    frames = list(sequence)
    np.testing.assert_allclose([frame.timestamp for frame in frames], [0.2, 0.5, 0.8])
    np.testing.assert_allclose([frame.step for frame in frames], 0.1)
    again = sequence.frame(0)
    np.testing.assert_array_equal(again.image.numpy(), frames[0].image.numpy())
    assert abs(float(frames[2].image[50, 80, 0]) * 255 - 160) <= 4


def test_an_unknown_focal_length_is_guessed_and_said(tmp_path: Path):
    for number in range(3):
        save(tmp_path / f"{number}.png", picture(number, 64, 48))
    sequence = open_sequence(str(tmp_path), InputOptions(focal="fixed"))
    assert sequence.camera.fx == pytest.approx(0.85 * 64)
    assert len(sequence.warnings) == 1 and "--fx" in sequence.warnings[0]
    assert sequence.ground_truth is None and sequence.sensor_depth(0) is None


def test_the_focal_length_is_guessed_from_the_picture_between_black_bars(tmp_path: Path):
    for number in range(3):
        wide = np.zeros((96, 192, 3), np.uint8)  # an upright film of 64x96 in a wide one
        wide[:, 64:128] = np.maximum(picture(number, 64, 96), 40)
        save(tmp_path / f"{number}.png", wide)
    sequence = open_sequence(str(tmp_path), InputOptions(size=(40, 64)))
    assert "cut to 60x96" in sequence.description
    assert sequence.prepare.raw_camera.fx == pytest.approx(0.85 * 96)
    assert sequence.camera.cx == pytest.approx(19.5, abs=0.51)


def test_what_the_user_gives_wins(tmp_path: Path):
    folder = str(tum_folder(tmp_path / "a"))
    assert open_sequence(folder, InputOptions(fx=60.0)).camera == Camera(60, 60, 23, 16, 48, 32)
    assert open_sequence(folder, InputOptions(cx=20.0)).camera == Camera(40, 41, 20, 16, 48, 32)
    (tmp_path / "other.txt").write_text("100 100 47.5 31.5 96 64")
    given = InputOptions(calibration=str(tmp_path / "other.txt"))
    assert open_sequence(folder, given).camera == Camera(50, 50, 23.5, 15.5, 48, 32)
    (tmp_path / "a/calibration.txt").unlink()
    known = open_sequence(folder, InputOptions(fx=60.0))
    assert known.warnings == []
    assert known.camera == Camera(60, 60, 23.5, 15.5, 48, 32)


@pytest.mark.parametrize(
    ("given", "angle", "unit"),
    [
        ({"fx": 3.0}, 166, "in millimetres"),
        ({"fx": 400.0}, 7, "for larger images"),
        ({"fy": 3.0}, 166, "in millimetres"),  # calibration.txt has fx = 40
        ({"fx": 12.0}, 127, None),
        ({"fx": 170.0}, 16, None),  # and 11 over the shorter side
    ],
)
def test_a_focal_length_that_no_lens_has_is_warned_of(
    tmp_path: Path, given: dict[str, float], angle: int, unit: str | None
):
    ((name, focal),) = given.items()
    said = f"{name} {focal:g} px means a field of view of {angle} degrees: check if it is {unit}"
    warnings = open_sequence(str(tum_folder(tmp_path)), InputOptions(**given)).warnings
    assert warnings == ([said] if unit else [])


def test_a_picture_of_10_bits_in_16_is_warned_of(tmp_path: Path):
    for number in range(2):
        save(tmp_path / f"{number}.png", picture(number).astype(np.uint16) * 4)
    (warning,) = open_sequence(str(tmp_path)).warnings
    assert "0.png is almost black, its largest value 3 of 255: if it holds 10 or 12" in warning
    for number in range(2):
        save(tmp_path / f"{number}.png", picture(number).astype(np.uint16) * 256)
    assert open_sequence(str(tmp_path)).warnings == []


def test_the_focal_length_is_refined_where_it_is_not_known(tmp_path: Path):
    folder = tum_folder(tmp_path / "a")
    expected = {"auto": False, "fixed": False, "refine": True}
    for focal, refines in expected.items():
        assert open_sequence(str(folder), InputOptions(focal=focal)).refines_focal == refines
    (folder / "calibration.txt").unlink()
    for given, refines in (({}, True), ({"cx": 20.0}, True), ({"fx": 60.0}, False)):
        sequence = open_sequence(str(folder), InputOptions(**given))
        assert sequence.refines_focal == refines and sequence.warnings == []
        assert sequence.focal_origin == ("" if refines else "intrinsics given")


def test_a_lens_is_sought_where_nothing_is_known_and_straightened_by_its_options(tmp_path: Path):
    folder = tum_folder(tmp_path / "a")
    assert not open_sequence(str(folder), InputOptions(focal="refine")).seeks_lens
    (folder / "calibration.txt").unlink()
    for given in ({"fx": 60.0}, {"focal": "fixed"}, {"focal": "refine"}, {"k1": -0.2}, {"k2": 0.1}):
        assert not open_sequence(str(folder), InputOptions(**given)).seeks_lens
    bent = open_sequence(str(folder), InputOptions(cx=20.0))
    assert bent.seeks_lens
    straight = bent.through_lens(0.5 * bent.camera.fx, -0.2, 0.05)
    raw = bent.preparation["raw_camera"]
    assert straight.opened_as["input"] == bent.opened_as["input"] | {
        "fx": 0.5 * raw["fx"], "fy": 0.5 * raw["fy"], "k1": -0.2, "k2": 0.05, "focal": "refine"
    }  # fmt: skip
    assert straight.refines_focal and not straight.seeks_lens
    assert straight.camera.fx == pytest.approx(0.5 * bent.camera.fx) and straight.camera.cx == 20
    again = open_sequence(str(folder), InputOptions(**straight.opened_as["input"]))
    assert np.array_equal(again.frame(1).pixels, straight.frame(1).pixels)
    assert not np.array_equal(bent.frame(1).pixels, straight.frame(1).pixels)
    assert again.preparation["distortion"] == dict(k1=-0.2, k2=0.05, p1=0, p2=0, k3=0)


def test_a_focal_length_noted_in_a_photo_is_the_start(tmp_path: Path):
    for number in range(3):
        path = save(tmp_path / f"{number}.jpg", picture(number, 64, 48))
        path.write_bytes(exif({0xA405: (3, 26)}) + path.read_bytes()[2:])
    sequence = open_sequence(str(tmp_path))
    assert sequence.camera.fx == pytest.approx(26 / 43.267 * 80, rel=1e-4)
    assert sequence.refines_focal
    assert sequence.focal_origin == "EXIF of 0.jpg"
    assert sequence.description.endswith("EXIF of 0.jpg, focal length to be refined")


def test_the_size_given_is_exact(tmp_path: Path):
    folder = str(tum_folder(tmp_path))
    sequence = open_sequence(folder, InputOptions(size=(20, 17)))
    assert sequence.frame(0).image.shape == (17, 20, 3)
    assert sequence.sensor_depth(0).shape == (17, 20)


def test_what_the_options_name_is_found_again_from_any_folder(tmp_path: Path, monkeypatch):
    folder = tum_folder(tmp_path / "desk")
    monkeypatch.chdir(folder)
    (folder / "lens.txt").write_text("50 50 23 16\n")
    options = InputOptions(calibration="lens.txt", masks="files:masks")
    opened = open_sequence("../desk", options)
    monkeypatch.chdir(tmp_path)
    again = open_sequence(opened.opened_as["sequence"], InputOptions(**opened.opened_as["input"]))
    assert again.camera.fx == 50 and again.description == opened.description
    assert again.given_mask(1).any() and again.opened_as == opened.opened_as


# Identities


def test_walking_twice_gives_the_same_frames(tmp_path: Path):
    sequence = open_sequence(str(tum_folder(tmp_path)))
    for first, second in zip(sequence, sequence, strict=True):
        assert first.timestamp == second.timestamp
        np.testing.assert_array_equal(first.image.numpy(), second.image.numpy())


# Errors


@pytest.mark.parametrize(
    "source", ["missing", "synth:nobody", "synth:crowd:x", "synth:", "empty", "notes.txt"]
)
def test_wrong_sources_give_one_sentence(tmp_path: Path, monkeypatch, source: str):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("hello")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="expected") as caught:
        open_sequence(source)
    assert source in str(caught.value) and "\n" not in str(caught.value)


def test_a_path_is_a_source_and_options_take_their_types_or_are_refused(tmp_path: Path):
    folder = tum_folder(tmp_path / "desk")
    sequence = open_sequence(folder, InputOptions(fx="60", size="24, 16"))
    assert (sequence.camera.fx, sequence.camera.width) == (30, 24)
    assert sequence.opened_as["sequence"] == str(folder)
    for name, wrong in (("stride", 2.5), ("masks", folder), ("size", "320x240"), ("fx", "wide")):
        with pytest.raises(InputError, match=f"expected {name} to be "):
            open_sequence(folder, InputOptions(**{name: wrong}))


def test_one_pixel_images_are_refused(tmp_path: Path):
    for number in range(2):
        save(tmp_path / f"{number}.png", picture(1, 1, 1))
    with pytest.raises(InputError, match="found 1x1"):
        open_sequence(str(tmp_path))


def test_fy_without_fx_makes_no_pixels_of_two_lengths(tmp_path: Path):
    folder = tum_folder(tmp_path)
    assert open_sequence(str(folder), InputOptions(fy=50.0)).camera.fx == 40
    (folder / "calibration.txt").unlink()
    with pytest.raises(InputError, match="expected --fx with --fy, found --fy alone; give both"):
        open_sequence(str(folder), InputOptions(fy=50.0))


@pytest.mark.parametrize(
    ("options", "count"), [({"start": 6}, 0), ({"start": 5}, 1), ({"stride": 50}, 1)]
)
def test_less_than_two_frames_are_refused(tmp_path: Path, options: dict, count: int):
    folder = str(tum_folder(tmp_path))
    with pytest.raises(InputError, match=f"at least two frames, found {count} among 6 images of"):
        open_sequence(folder, InputOptions(**options))


def test_a_video_of_which_one_frame_is_wanted_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="found 1 among 1 images of v after --start, --stride and"):
        open_sequence(str(video(tmp_path / "v.mp4")), InputOptions(max_frames=1))


def test_a_frame_outside_the_sequence_is_an_index_error(tmp_path: Path):
    sequence = open_sequence(str(tum_folder(tmp_path)))
    with pytest.raises(IndexError):
        sequence.frame(6)


def test_timestamps_that_files_cannot_tell_apart_are_refused_before_a_run(tmp_path: Path):
    for number in range(1, 4):
        save(tmp_path / f"close/0.{number:07d}.png", picture(number))
    with pytest.raises(InputError, match="timestamps that increase by a microsecond"):
        open_sequence(str(tmp_path / "close"))


def test_a_binary_readme_is_no_reason_to_refuse_a_folder(tmp_path: Path):
    folder = tum_folder(tmp_path / "desk")
    (folder / "calibration.txt").unlink()
    (folder / "README.dat").write_bytes(b"\xff\xfe\x00\x80" * 9)
    assert len(open_sequence(str(folder))) == 6
