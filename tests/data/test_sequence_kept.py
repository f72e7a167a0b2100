"""Frames are prepared once: their working images are kept in a temporary file."""

import tempfile
from pathlib import Path

import numpy as np
import pytest

from minislam.data.raw_images import FileImages
from minislam.data.sequence import RecordedSequence, open_sequence
from tests.recordings import picture, save


@pytest.fixture
def reads() -> list[int]:
    """The images that were read, in order."""
    return []


@pytest.fixture
def sequence(tmp_path: Path, monkeypatch, reads: list[int]) -> RecordedSequence:
    for number in range(8):
        save(tmp_path / f"{number}.png", picture(number))
    opened = open_sequence(str(tmp_path))
    images = opened._recording.images
    read = images.read
    monkeypatch.setattr(images, "read", lambda index: reads.append(index) or read(index))
    return opened


def test_each_image_is_prepared_once_and_comes_back_in_any_order(sequence, reads: list[int]):
    for number in (7, 0, 3, 0, 7, 3, 3):
        pixels = sequence.frame(number).pixels
        np.testing.assert_array_equal(pixels, picture(number))
        pixels[:] = 0  # what is returned is the caller's
    assert reads == [7, 0, 3]


def test_opening_reads_each_sampled_image_once(tmp_path: Path, monkeypatch, reads: list[int]):
    for number in range(8):
        save(tmp_path / f"{number}.png", picture(number))
    read = FileImages.read
    monkeypatch.setattr(FileImages, "read", lambda self, k: reads.append(k) or read(self, k))
    open_sequence(str(tmp_path))
    assert reads == [0, 0, 1, 2, 4]  # the first one for its size, too


def test_a_full_disk_costs_time_only(sequence, reads: list[int], monkeypatch):
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    for _ in range(2):
        np.testing.assert_array_equal(sequence.frame(1).pixels, picture(1))
    assert reads == [1, 1]


def test_an_image_that_cannot_be_prepared_is_not_kept(sequence, reads: list[int], monkeypatch):
    first = sequence.frame(0)
    with monkeypatch.context() as broken:
        broken.setattr(sequence.prepare, "pixels", lambda *_: 1 / 0)
        for _ in range(2):
            with pytest.raises(ZeroDivisionError):
                sequence.frame(1)
        np.testing.assert_array_equal(sequence.frame(0).pixels, first.pixels)
    np.testing.assert_array_equal(sequence.frame(1).pixels, picture(1))
    assert reads == [0, 1, 1, 1]
