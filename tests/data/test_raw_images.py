"""Videos: counting, random access, rotation, damaged files."""

import os
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from minislam.data import raw_images
from minislam.data.options import InputOptions
from minislam.data.raw_images import VideoImages
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.data.sources import read_image_folder, read_video
from minislam.errors import InputError
from tests.recordings import picture, save, video

# Known answers


def test_frames_are_counted_and_stamped_by_their_rate(tmp_path: Path):
    recording = read_video(video(tmp_path / "walk in park.mp4", count=12, rate=10), None)
    assert len(recording.images) == 12 and recording.name == "walk_in_park"
    np.testing.assert_allclose(recording.timestamps, np.arange(12) / 10)
    assert recording.images.read(3).shape == (64, 96, 3)


@pytest.mark.parametrize(
    ("stride", "most", "said"),
    [(2, 3, "first 5 images of a video: 3 of 5 images,"), (1, 12, "video: 12 of 12 images,")],
)
def test_of_a_video_that_is_not_read_to_its_end_no_total_is_said(
    tmp_path: Path, stride, most, said
):
    options = InputOptions(stride=stride, max_frames=most)
    sequence = open_sequence(str(video(tmp_path / "walk.mp4", count=12)), options)
    assert sequence.description.startswith(said)


def test_a_name_with_a_colon_is_no_protocol(tmp_path: Path, monkeypatch):
    video(tmp_path / "12:30.mp4")
    monkeypatch.chdir(tmp_path)
    assert len(VideoImages(Path("12:30.mp4"))) > 0


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names are text")
def test_a_name_that_is_no_text_is_refused(tmp_path: Path):
    name = tmp_path / os.fsdecode(b"caf\xe9.mp4")
    video(tmp_path / "v.mp4").rename(name)
    with pytest.raises(InputError, match=r"expected a video whose name is text, found .*udce9"):
        VideoImages(name)


def test_any_frame_can_be_read_in_any_order(tmp_path: Path):
    images = VideoImages(video(tmp_path / "v.mp4"))
    for index in (0, 1, 5, 5, 2, 11, 0, 11):
        assert abs(int(images.read(index)[50, 80, 0]) - 20 * index) <= 4, index


def test_the_same_frame_again_is_not_looked_for_from_the_start(tmp_path: Path, monkeypatch):
    images = VideoImages(video(tmp_path / "v.mp4"))
    first = images.read(5)
    monkeypatch.setattr(images, "_rewind", lambda: pytest.fail("read from the start"))
    np.testing.assert_array_equal(images.read(5), first)
    assert abs(int(images.read(6)[50, 80, 0]) - 120) <= 4


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


def test_images_far_apart_tell_what_is_not_black(tmp_path: Path):
    frames = np.zeros((40, 48, 64, 3), np.uint8)
    for index, frame in enumerate(frames):
        frame[8:40, index] = 200  # a bright column that walks along
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
    (tmp_path / "b").mkdir()
    for index, frame in enumerate(frames):
        writer.write(frame)
        cv2.imwrite(str(tmp_path / f"b/{index:02d}.png"), frame)
    writer.release()
    (tmp_path / "b/16.png").write_bytes(b"no picture")  # told when it is its turn
    video, folder = read_video(tmp_path / "a.avi", None), read_image_folder(tmp_path / "b")
    for images, sampled in (
        (video.images, [0, 1, 2, 4, 8, 16, 32]),
        (folder.images, [0, 1, 2, 4, 8, 32]),
    ):
        assert len(images.glances) == len(sampled)
        for index, glance in zip(sampled, images.glances, strict=True):
            columns, rows = glance.lit
            np.testing.assert_allclose(np.flatnonzero(columns), index, atol=2)
            np.testing.assert_allclose(np.flatnonzero(rows)[[0, -1]], [8, 39], atol=2)
    cv2.imwrite(str(tmp_path / "b/00.png"), frames[0][::2])  # of another size than the others
    folder = read_image_folder(tmp_path / "b")
    lit = [np.flatnonzero(glance.lit[0]) for glance in folder.images.glances]
    assert [index.tolist() for index in lit[:2]] == [[1], [2]]


# Damage


def long_video(path: Path, rate: float = 30) -> Path:
    """Write 60 frames of a moving texture, compressed to about a kilobyte each."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (96, 64))
    texture = np.random.default_rng(0).integers(0, 256, (8, 24, 3)).astype(np.uint8)
    texture = cv2.resize(texture, (288, 64), interpolation=cv2.INTER_CUBIC)
    for number in range(60):
        writer.write(np.ascontiguousarray(texture[:, 3 * number : 3 * number + 96]))
    writer.release()
    return path


def test_frames_lost_in_the_middle_are_listed_and_those_behind_are_read(tmp_path: Path):
    content = long_video(tmp_path / "whole.mkv").read_bytes()
    middle = len(content) // 2
    (tmp_path / "hole.mkv").write_bytes(content[:middle] + content[middle + 4096 :])
    recording = read_video(tmp_path / "hole.mkv", None)
    count, lost = len(recording.images), [stamp for stamp, _ in recording.unread]
    assert 30 < count < 60 and count + len(lost) == 60
    assert recording.timestamps[-1] == pytest.approx(59 / 30, abs=1e-3)  # behind the hole
    stamps = np.sort(np.concatenate([recording.timestamps, lost]))
    np.testing.assert_allclose(stamps, np.arange(60) / 30, atol=2e-3)
    assert f"hole.mkv promises 60 frames, but only {count} can be decoded" in recording.warnings[0]
    sequence = RecordedSequence(recording, InputOptions(), "hole.mkv")
    assert sequence.unread == recording.unread and len(sequence) == count
    part = RecordedSequence(recording, InputOptions(max_frames=10), "hole.mkv")
    assert part.unread == []  # nothing is lost of the frames that are asked for


def test_a_cut_video_is_warned_of(tmp_path: Path):
    content = long_video(tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: int(0.6 * len(content))])
    recording = read_video(tmp_path / "cut.avi", None)
    assert 20 < len(recording.images) < 60 and recording.unread == []
    assert "promises 60 frames" in recording.warnings[0]
    assert read_video(tmp_path / "cut.avi", 10).warnings == []


def test_a_whole_video_is_not_warned_of(tmp_path: Path):
    for name in ("a.mp4", "a.mkv", "a.avi"):
        recording = read_video(long_video(tmp_path / name), None)
        assert (recording.warnings, recording.unread, len(recording.images)) == ([], [], 60)


class Capture:
    """A video of six frames of varying distance; the third cannot be decoded."""

    stamps = (0.0, 0.1, None, 0.2, 0.233, 0.4)

    def __init__(self) -> None:
        self.next = 0

    def get(self, what: int) -> float:
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1000 * self.stamps[self.next - 1]
        known = {cv2.CAP_PROP_FPS: 30, cv2.CAP_PROP_FRAME_COUNT: len(self.stamps)}
        return known.get(what, -1)

    def grab(self) -> bool:
        self.next += 1
        return self.next <= len(self.stamps) and self.stamps[self.next - 1] is not None

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((64, 96, 3), self.next, np.uint8)

    def isOpened(self) -> bool:
        return True


@pytest.fixture
def phone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(raw_images.cv2, "VideoCapture", lambda *_: Capture())
    (tmp_path / "phone.mp4").touch()
    return tmp_path / "phone.mp4"


def test_timestamps_are_those_of_the_container_and_a_bad_frame_is_passed_over(phone: Path):
    recording = read_video(phone, None)
    np.testing.assert_allclose(recording.timestamps, [0, 0.1, 0.2, 0.233, 0.4])
    assert [recording.images.read(k)[0, 0, 0] for k in (0, 2, 4, 1)] == [1, 4, 6, 2]
    assert recording.unread == [(pytest.approx(0.15), "phone.mp4 is damaged there")]
    assert "promises 6 frames, but only 5 can be decoded" in recording.warnings[0]


@pytest.mark.parametrize("limit", [None, 5])
def test_a_pause_of_the_recorder_is_no_damage(phone: Path, limit: int | None, monkeypatch):
    monkeypatch.setattr(Capture, "stamps", tuple(k / 30 for k in (0, 1, 2, 3, 7, 8)))
    recording = read_video(phone, limit)
    assert (recording.unread, recording.warnings) == ([], [])
    assert len(recording.images) == (limit or 6)


def test_without_timestamps_the_frame_rate_is_taken_and_said(phone: Path, monkeypatch):
    monkeypatch.setattr(Capture, "stamps", (0.0,) * 6)
    recording = read_video(phone, None)
    np.testing.assert_allclose(recording.timestamps, np.arange(6) / 30)
    assert recording.warnings == [
        "phone.mp4 has no times that increase: 30 frames per second assumed"
    ]


def test_the_rate_of_a_clock_is_no_frame_rate(phone: Path, monkeypatch):
    monkeypatch.setattr(Capture, "stamps", tuple(k / 2 for k in range(6)))
    recording = read_video(phone, None)
    assert recording.warnings == [] and recording.notes == ["2 frames per second"]


# Errors


@pytest.mark.parametrize("kind", ["zero bytes", "text", "cut", "list"])
def test_files_that_are_no_video_are_named(tmp_path: Path, kind: str):
    path = tmp_path / "walk.mp4"
    whole = video(tmp_path / "whole.mp4").read_bytes()
    of_others = b"ffconcat version 1.0\nfile whole.mp4\n"
    contents = {"zero bytes": b"", "text": b"hello\n" * 99, "cut": whole[:1500], "list": of_others}
    path.write_bytes(contents[kind])
    with pytest.raises(InputError, match=r"walk\.mp4"):
        read_video(path, None)


def test_an_mp4_without_its_end_is_cut_short(tmp_path: Path):
    whole = video(tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: whole.index(b"moov") - 4])
    with pytest.raises(InputError, match="cannot be opened as one; the file is cut short, copy it"):
        read_video(tmp_path / "cut.mp4", None)
    for name in ("text.mp4", "notes.txt"):  # FFmpeg films the second on a terminal
        (tmp_path / name).write_bytes(b"hello\n" * 99)
        with pytest.raises(InputError, match="cannot be opened as one; convert it to MP4"):
            read_video(tmp_path / name, None)


def test_a_single_picture_is_no_video(tmp_path: Path):
    with pytest.raises(InputError, match="single image"):
        read_video(save(tmp_path / "a.png", picture(0)), None)
