"""Animations are read back by OpenCV: as many images, their size, order and colours."""

import errno
import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from minislam.data.images import write_animation
from minislam.errors import InputError

REDS = np.linspace(0.1, 0.9, 8)


def images():
    for red in REDS:
        image = np.full((32, 48, 3), 0.5)
        image[:, :24, 0] = red
        yield image


def test_webp_holds_the_images_in_order(tmp_path: Path):
    write_animation(tmp_path / "a.webp", images(), 10.0)
    _, animation = cv2.imreadanimation(str(tmp_path / "a.webp"))
    found = [frame[16, 12, 2] / 255 for frame in animation.frames]  # BGR
    np.testing.assert_allclose(found, REDS, atol=0.05)
    assert list(animation.durations) == [100] * len(REDS)


def test_webm_holds_the_images_in_order(tmp_path: Path, capfd):
    write_animation(tmp_path / "a.webm", images(), 10.0)
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "a.webm").read_bytes()[:4] == b"\x1a\x45\xdf\xa3"  # EBML, as browsers expect
    capture = cv2.VideoCapture(str(tmp_path / "a.webm"))
    found = [capture.read()[1][16, 12, 2] / 255 for _ in REDS]
    np.testing.assert_allclose(found, REDS, atol=0.05)
    assert not capture.read()[0]


def test_another_kind_and_nothing_to_show_are_said(tmp_path: Path):
    with pytest.raises(InputError, match=r"ends in \.webm or \.webp, found \.mp4"):
        write_animation(tmp_path / "a.mp4", images(), 10.0)
    for kind in (".webm", ".webp"):
        with pytest.raises(InputError, match="expected an OpenCV"):
            write_animation(tmp_path / f"a{kind}", [], 10.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [".webm", ".webp"])
def test_a_full_disk_leaves_no_film_that_is_cut_short(tmp_path: Path, monkeypatch, kind: str):
    (tmp_path / f"a{kind}").write_text("before", encoding="utf-8")

    def full(dir: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", dir)

    with monkeypatch.context() as patch:
        patch.setattr(tempfile, "TemporaryFile", full)
        with pytest.raises(InputError, match=r"expected space for an animation in .*TMPDIR"):
            write_animation(tmp_path / f"a{kind}", images(), 10.0)
    assert (tmp_path / f"a{kind}").read_text(encoding="utf-8") == "before"


@pytest.mark.parametrize("kind", [".webm", ".webp"])
def test_a_temporary_folder_whose_name_is_no_text_is_said(tmp_path: Path, monkeypatch, kind: str):
    (tmp_path / os.fsdecode(b"\xe9")).mkdir()  # no UTF-8
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / os.fsdecode(b"\xe9")))
    with pytest.raises(InputError, match=r"whose name is text, found .*udce9.*; set TMPDIR"):
        write_animation(tmp_path / f"a{kind}", images(), 10.0)
