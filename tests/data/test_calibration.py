"""Intrinsics from files, from known benchmarks, and the guess."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.calibration import (
    Calibration,
    read_calibration,
    rough_calibration,
)
from minislam.errors import InputError
from minislam.geometry import BrownDistortion, Camera


def read(text: str, folder: Path) -> Calibration:
    (folder / "kinect.txt").write_text(text)
    return read_calibration(folder / "kinect.txt")


# Known answers


def test_four_six_and_eleven_numbers(tmp_path: Path):
    path = tmp_path / "calibration.txt"
    path.write_bytes(b"\xef\xbb\xbf# fx fy cx cy\r\n500 501 320 240\r\n")
    assert read_calibration(path).camera_for(640, 480) == Camera(500, 501, 320, 240, 640, 480)
    six = read("500, 501, 320, 240, 640, 480", tmp_path)
    assert six.size == (640, 480)
    eleven = read("500 501 320 240 640 480 0.1 0.2 0.3 0.4 0.5", tmp_path)
    assert eleven.distortion == BrownDistortion(0.1, 0.2, 0.3, 0.4, 0.5)


def test_a_calibration_is_carried_to_images_resized_by_half(tmp_path: Path):
    calibration = read("500 500 319.5 239.5 640 480", tmp_path)
    assert calibration.camera_for(320, 240) == Camera(250, 250, 159.5, 119.5, 320, 240)


def test_the_guess_is_a_field_of_view_of_about_sixty_degrees():
    for width, height in ((1280, 720), (720, 1280)):
        camera = rough_calibration((0, 0, width, height)).camera_for(width, height)
        angle = 2 * np.degrees(np.arctan(max(width, height) / 2 / camera.fx))
        assert 55 < angle < 65
        assert (camera.cx, camera.cy) == ((width - 1) / 2, (height - 1) / 2)


def test_the_guess_is_of_the_picture_between_black_bars():
    upright, alone = rough_calibration((656, 0, 608, 1080)), rough_calibration((0, 0, 608, 1080))
    assert (upright.fx, upright.cx, upright.cy) == (alone.fx, 656 + alone.cx, alone.cy)


def test_a_noted_focal_length_comes_before_the_guess(tmp_path: Path):
    noted = rough_calibration((0, 0, 400, 300), (0.6, "EXIF of a photo"))
    assert (noted.fx, noted.fy, noted.origin) == (300, 300, "EXIF of a photo")
    assert noted.is_rough and not read("500 500 320 240", tmp_path).is_rough


# Errors


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "found 0"),
        ("500 500 320", "found 3"),
        ("500 500 320 240 640", "found 5"),
        ("500 500 320 240 640 480 0.1", "found 7"),
        ("500 abc 320 240", "finite"),
        ("500 nan 320 240", "finite"),
        (
            "-500 500 320 240",
            r"of at least 1 and at most 50000, found \(-500.0, 500.0\)",
        ),
        ("500 0.99 320 240", "in pixels"),
        ("0.85 1.13 0.5 0.5", "in pixels"),  # over the sides of the image
        ("500 1e300 320 240", "in pixels"),
        ("500 500 320 240 640.5 480", "whole"),
        ("500 500 320 240 0 480", "whole"),
    ],
)
def test_wrong_calibrations_name_the_file(text: str, message: str, tmp_path: Path):
    with pytest.raises(InputError, match=message) as caught:
        read(text, tmp_path).camera_for(640, 480)
    assert "kinect.txt" in str(caught.value)


def test_a_centre_outside_the_image_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"kinect.*principal point inside"):
        read("500 500 700 240", tmp_path).camera_for(640, 480)


def test_images_of_another_shape_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="do not match"):
        read("500 500 320 240 640 480", tmp_path).camera_for(1280, 720)
