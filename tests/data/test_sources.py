"""Videos: counting, random access, rotation, damaged files."""

import struct
from pathlib import Path

import numpy as np
import pytest

from minislam.data.folder import read_video
from minislam.data.sources import VideoImages
from minislam.errors import InputError
from tests.recordings import picture, save, video

# Known answers


def test_frames_are_counted_and_stamped_by_their_rate(tmp_path: Path):
    recording = read_video(video(tmp_path / "walk in park.mp4", count=12, rate=10), None)
    assert len(recording.images) == 12 and recording.name == "walk_in_park"
    np.testing.assert_allclose(recording.timestamps, np.arange(12) / 10)
    assert recording.images.read(3).shape == (64, 96, 3)


def test_any_frame_can_be_read_in_any_order(tmp_path: Path):
    images = VideoImages(video(tmp_path / "v.mp4"))
    for index in (0, 1, 5, 5, 2, 11, 0, 11):
        assert abs(int(images.read(index)[50, 80, 0]) - 20 * index) <= 4, index


def test_colours_are_rgb(tmp_path: Path):
    corner = VideoImages(video(tmp_path / "v.mp4")).read(0)[5, 5]
    assert corner[0] > 180 and corner[2] < 60


def test_no_more_frames_are_counted_than_are_wanted(tmp_path: Path):
    assert len(VideoImages(video(tmp_path / "v.mp4"), limit=4)) == 4


def test_a_video_filmed_upright_is_turned(tmp_path: Path):
    # The display matrix of the track header (nine 16.16 numbers after 40 bytes) says "turn by 90
    # degrees"; that is how phones store portrait videos.
    content = bytearray(video(tmp_path / "v.mp4").read_bytes())
    start = content.index(b"tkhd") + 4 + 40
    assert struct.unpack_from(">9i", content, start)[0] == 1 << 16
    struct.pack_into(">9i", content, start, 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    (tmp_path / "turned.mp4").write_bytes(content)
    image = VideoImages(tmp_path / "turned.mp4").read(0)
    assert image.shape == (96, 64, 3)
    assert image[5, 55, 0] > 180  # the red corner went from the upper left to the upper right


# Errors


@pytest.mark.parametrize("kind", ["zero bytes", "text", "cut"])
def test_files_that_are_no_video_are_named(tmp_path: Path, kind: str):
    path = tmp_path / "walk.mp4"
    whole = video(tmp_path / "whole.mp4").read_bytes()
    path.write_bytes({"zero bytes": b"", "text": b"hello\n" * 99, "cut": whole[:1500]}[kind])
    with pytest.raises(InputError, match=r"walk\.mp4"):
        read_video(path, None)


def test_a_single_picture_is_no_video(tmp_path: Path):
    with pytest.raises(InputError, match="single image"):
        read_video(save(tmp_path / "a.png", picture(0)), None)
