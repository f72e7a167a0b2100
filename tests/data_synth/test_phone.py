"""What a phone does to images: leaning edges, drifting light, blur, turned videos."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from data_synth import Phone, SynthError, film, phone_intrinsics, write_sequence, write_video
from data_synth.cli import main
from data_synth.phone import DRIFT_SECONDS
from data_synth.poses import Intrinsics, look_at, upright
from data_synth.rooms import Room
from data_synth.shapes import Box, Interior, Part
from tests.data_synth.paints import plain

CAMERA = Intrinsics(fx=70.0, fy=70.0, cx=40.3, cy=29.1, width=80, height=60)
UPRIGHT = replace(CAMERA, cx=29.1, cy=40.3, width=60, height=80)
NOTHING = Phone(0.0, 0.0, 0.0, 0.0)
AWAY = 2.0  # m, from the camera to the red plate
SPEED = 6.0  # m/s
READOUT = 0.03  # s

WALLS = Part(Interior((9.0, 9.0, 9.0)), upright([0, 0, 0]), plain(0.4, 0.4, 0.4))
ROOM = Room((WALLS,), np.array([0.0, -3.0, 3.0]), np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class Plates:
    """A thin red plate whose edge is at x = 0, z = 0 at time 0, seen from y = -2 m."""

    plate: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s
    camera: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s
    corner: tuple[float, float, float] = (-2.0, 0.0, 0.0)  # m, the plate's centre at time 0
    room: Room = ROOM

    def mover_parts(self, time: float) -> list[list[Part]]:
        place = np.array(self.corner) + time * np.array(self.plate)
        return [[Part(Box((4.0, 0.01, 4.0)), upright(place), plain(0.9, 0.1, 0.1))]]

    def path(self, time: float) -> np.ndarray:
        place = np.array([0.0, -AWAY, 0.0]) + time * np.array(self.camera)
        return look_at(place, place + np.array([0.0, 1.0, 0.0]))


def edges(image: np.ndarray) -> np.ndarray:
    """Return for each row the column at which red ends, to a fraction of a pixel."""
    red = (image[..., 0] - image[..., 1]) / (image[..., 0] - image[..., 1]).max()
    first = (red < 0.5).argmax(1)
    rows = np.arange(len(red))
    before, after = red[rows, first - 1], red[rows, first]
    return first - 1 + (before - 0.5) / (before - after)


# Known answers


@pytest.mark.parametrize(
    "view, lean",
    [
        (Plates(plate=(SPEED, 0, 0)), +1),
        (Plates(camera=(SPEED, 0, 0)), -1),
        (Plates(plate=(SPEED, 0, 0), camera=(SPEED, 0, 0)), 0),
    ],
    ids=["mover", "camera", "both"],
)
def test_a_vertical_edge_leans_by_velocity_times_readout(view: Plates, lean: int):
    image = film(view, CAMERA, 0.0, replace(NOTHING, readout=READOUT, band=1))
    slope, _ = np.polyfit(np.arange(60), edges(image), 1)
    # The last row is READOUT later than the first: the edge is SPEED * READOUT metres further.
    expected = lean * CAMERA.fx / AWAY * SPEED * READOUT / 60
    assert slope == pytest.approx(expected, abs=0.03 * CAMERA.fx / AWAY * SPEED * READOUT / 60)


def test_a_phone_held_upright_reads_from_left_to_right():
    sinking = Plates(plate=(0, 0, -SPEED), corner=(0.0, 0.0, 2.0))  # a lower edge that sinks
    image = film(sinking, UPRIGHT, 0.0, replace(NOTHING, readout=READOUT, band=1))
    slope, _ = np.polyfit(np.arange(60), edges(image.transpose(1, 0, 2)), 1)
    assert slope == pytest.approx(UPRIGHT.fy / AWAY * SPEED * READOUT / 60, rel=0.03)


def test_the_light_is_multiplied_by_the_gains_that_were_asked_for():
    plain_image = film(Plates(), CAMERA, 0.4, NOTHING)
    phone = replace(NOTHING, exposure=0.3, white=0.1)
    drifted = film(Plates(), CAMERA, 0.4, phone)
    visible = (plain_image > 0.05).all(-1) & (drifted < 0.99).all(-1)
    ratios = drifted[visible] / plain_image[visible]
    np.testing.assert_allclose(ratios, np.broadcast_to(phone.gains(0.4), ratios.shape), rtol=1e-4)
    assert phone.gains(DRIFT_SECONDS / 4)[1] == pytest.approx(2**0.3)
    np.testing.assert_allclose(phone.gains(0.0), [1 + 0.1 * np.sin(1), 1, 1 - 0.1 * np.sin(1)])


def test_blur_is_the_mean_of_the_pictures_while_the_shutter_is_open():
    view = Plates(plate=(SPEED, 0, 0))
    blurred = film(view, CAMERA, 0.0, replace(NOTHING, shutter=0.02, subframes=4))
    moments = 0.02 * np.array([-0.375, -0.125, 0.125, 0.375])
    sharp = np.mean([film(view, CAMERA, moment, NOTHING) for moment in moments], axis=0)
    np.testing.assert_allclose(blurred, sharp, atol=1e-5)


def test_an_upright_camera_is_the_lying_one_turned():
    lying, standing = phone_intrinsics((320, 240)), phone_intrinsics((240, 320))
    assert (standing.fx, standing.fy) == (lying.fx, lying.fy) == (272.0, 272.0)
    assert (standing.cx, standing.cy) == (lying.cy, lying.cx)


# Identities


def test_where_nothing_moves_the_shutter_changes_nothing():
    whole = film(Plates(), CAMERA, 0.0, NOTHING)
    rolled = film(Plates(), CAMERA, 0.0, replace(NOTHING, readout=READOUT, shutter=0.02, band=7))
    assert (np.abs(rolled - whole) < 1e-5).mean() > 0.999


def test_the_truth_is_that_of_the_middle_line():
    view = Plates(plate=(SPEED, 0, 0))
    rolled = film(view, CAMERA, 0.1, replace(NOTHING, readout=READOUT, band=12))
    whole = film(view, CAMERA, 0.1, NOTHING)
    middle = slice(26, 34)  # of the third of five bands, away from the lens blur at its ends
    np.testing.assert_allclose(rolled[middle], whole[middle], atol=1e-5)
    assert np.abs(rolled - whole).max() > 0.1


# Files


def test_a_video_filmed_upright_is_stored_lying_and_shown_upright(tmp_path: Path):
    frames = [np.full((64, 48, 3), 40, np.uint8) for _ in range(3)]
    frames[0][:16, :16] = (250, 20, 20)  # the red corner, upper left
    for turned in (False, True):
        write_video(tmp_path / "clip.mp4", frames, 30.0, turned)
        video = cv2.VideoCapture(str(tmp_path / "clip.mp4"))
        shown = video.read()[1][..., ::-1]
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
        assert shown.shape == (64, 48, 3) and shown[6, 6, 0] > 180 > 80 > shown[6, 40, 0]


@pytest.mark.parametrize("options, is_calibrated", [(["--phone"], False), (["--shutter=0"], True)])
def test_the_command_films_as_a_phone_without_a_calibration(tmp_path, options, is_calibrated):
    arguments = ["static", "--frames", "1", "--size", "24x32", "--out", str(tmp_path / "a")]
    assert main([*arguments, *options]) == 0
    assert (tmp_path / "a" / "calibration.txt").exists() == is_calibrated
    assert '"phone"' in (tmp_path / "a" / "synth.json").read_text()


# Errors


def test_impossible_phones_are_refused(tmp_path: Path):
    for wrong in ({"readout": -0.1}, {"white": 1.0}, {"band": 0}, {"subframes": 0}):
        with pytest.raises(SynthError, match="a phone"):
            replace(NOTHING, **wrong)
    with pytest.raises(SynthError, match="at least 1 frame"):
        write_video(tmp_path / "a.mp4", [], 30.0, False)
    write_sequence("static", 0, 1, (24, 16), tmp_path / "b")
    with pytest.raises(SynthError, match="name another folder"):
        write_sequence("static", 0, 1, (24, 16), tmp_path / "b", phone=Phone())
