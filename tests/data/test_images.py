"""Pictures as cameras write them: accepted kinds, and damaged files."""

import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from minislam.data.images import (
    encode_png,
    list_images,
    natural_key,
    read_color,
    read_depth,
    read_mask,
)
from minislam.data.metadata import noted_size
from minislam.errors import InputError
from tests.recordings import picture, save

# Known answers


def test_png_is_read_as_rgb(tmp_path: Path):
    image = picture(3)
    np.testing.assert_array_equal(read_color(save(tmp_path / "a.png", image)), image)


def test_grey_alpha_and_sixteen_bits_become_rgb(tmp_path: Path):
    grey = picture(1)[..., 0]
    expected = np.repeat(grey[..., None], 3, axis=2)
    np.testing.assert_array_equal(read_color(save(tmp_path / "grey.png", grey)), expected)
    alpha = np.dstack([picture(1)[..., ::-1], np.full_like(grey, 128)])  # BGRA
    np.testing.assert_array_equal(read_color(save(tmp_path / "alpha.png", alpha)), picture(1))
    deep = picture(1).astype(np.uint16) * 257  # 255 -> 65535
    np.testing.assert_array_equal(read_color(save(tmp_path / "deep.png", deep)), picture(1))


def test_depth_is_in_metres_and_zero_stays_unknown(tmp_path: Path):
    path = save(tmp_path / "d.png", np.array([[0, 5000], [10000, 65535]], np.uint16))
    np.testing.assert_allclose(read_depth(path, 5000), [[0, 1], [2, 13.107]])
    assert read_depth(path, 5000).dtype == np.float32


def test_mask_is_true_where_white(tmp_path: Path):
    path = save(tmp_path / "m.png", np.array([[0, 255], [127, 128]], np.uint8))
    np.testing.assert_array_equal(read_mask(path), [[False, True], [False, True]])


def test_a_film_that_a_phone_hides_behind_a_photo_does_no_harm(tmp_path: Path):
    photo = cv2.imencode(".jpg", picture(0, 32, 24))[1].tobytes()
    for film in (b"\xff\xd9", b"\xff\xda", b"\xff\xda\xff\xd9\xff\xda"):
        path = tmp_path / "photo.jpg"
        path.write_bytes(photo + b"\0\0\0\x18ftypmp42" + film)
        assert read_color(path).shape == (24, 32, 3)
    path.write_bytes(photo[:-40])
    with pytest.raises(InputError, match="is damaged"):
        read_color(path)


def test_a_mask_of_16_bits_is_read_at_its_full_range(tmp_path: Path):
    values = np.array([[0, 65535], [32767, 32768]], np.uint16)
    mask = read_mask(save(tmp_path / "m.png", values))
    np.testing.assert_array_equal(mask, [[False, True], [False, True]])
    np.testing.assert_array_equal(
        read_mask(save(tmp_path / "n.png", values & 255)), values & 255 > 127
    )
    with pytest.raises(InputError, match=r"expected a mask of 0 and 255, found 3 as .* write 255"):
        read_mask(save(tmp_path / "labels.png", np.array([[0, 3]], np.uint16)))
    with pytest.raises(InputError, match="expected a mask of 0 and 65535, found 300 as"):
        read_mask(save(tmp_path / "labels.png", np.array([[0, 300]], np.uint16)))


def test_what_is_transparent_in_a_mask_is_no_mask(tmp_path: Path):
    cut_out = np.full((2, 2, 4), 255, np.uint8)
    cut_out[0, 0, 3] = 0
    cv2.imwrite(str(tmp_path / "m.png"), cut_out)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[False, True], [True, True]])


def test_natural_order_of_300_files(tmp_path: Path):
    names = [f"frame {number}.png" for number in range(300)]
    for name in np.random.default_rng(0).permutation(names):
        save(tmp_path / str(name), picture(0, 8, 8))
    save(tmp_path / ".hidden.png", picture(0, 8, 8))
    (tmp_path / "notes.txt").write_text("no picture")
    assert [path.name for path in list_images(tmp_path)] == names


def test_names_of_all_kinds_can_be_compared():
    names = ["10.png", "a2.png", "2.png", "a10.png", "", "1a.png", "²3.png", "٣.png"]
    assert sorted(names, key=natural_key)[0] == ""
    assert sorted(["b10", "b9", "a11"], key=natural_key) == ["a11", "b9", "b10"]


# Identities


def test_encoded_png_is_read_back(tmp_path: Path):
    image = picture(5)
    for version in (image, image.astype(np.float32) / 255, image.astype(np.float64) / 255):
        (tmp_path / "x.png").write_bytes(encode_png(version))
        np.testing.assert_array_equal(read_color(tmp_path / "x.png"), image)
    assert encode_png(image) == encode_png(image)


def test_unicode_spaces_and_percent_in_names(tmp_path: Path):
    path = save(tmp_path / "été 50 % 画像.png", picture(2))
    np.testing.assert_array_equal(read_color(path), picture(2))


# Errors


def damaged(tmp_path: Path, kind: str) -> Path:
    if kind == "text":
        path = tmp_path / "text.png"
        path.write_text("I am not a picture.")
        return path
    suffix = kind.split()[1]
    path = save(tmp_path / f"damaged.{suffix}", picture(1, 64, 48))
    content = path.read_bytes()
    path.write_bytes(b"" if kind.startswith("empty") else content[: int(len(content) * 0.7)])
    return path


@pytest.mark.parametrize("kind", ["text", "cut png", "cut jpg", "empty png", "empty jpg"])
def test_damaged_pictures_are_refused_with_their_name(tmp_path: Path, kind: str):
    path = damaged(tmp_path, kind)
    with pytest.raises(InputError, match=path.name):
        read_color(path)


def test_a_cut_jpeg_with_a_whole_thumbnail_is_refused(tmp_path: Path):
    content = save(tmp_path / "a.jpg", picture(1, 64, 48)).read_bytes()
    # An application segment of the header carries a small JPEG of its own, end marker included.
    thumbnail = cv2.imencode(".jpg", picture(2, 16, 16))[1].tobytes()
    segment = b"\xff\xe5" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = content[:2] + segment + content[2:]
    (tmp_path / "whole.jpg").write_bytes(whole)
    assert read_color(tmp_path / "whole.jpg").shape == (48, 64, 3)
    (tmp_path / "cut.jpg").write_bytes(whole[:-40])
    with pytest.raises(InputError, match="cut"):
        read_color(tmp_path / "cut.jpg")


def jpeg(tmp_path: Path, seed: int = 0) -> bytes:
    """Return a file whose scan fills most of it."""
    noise = np.random.default_rng(seed).integers(0, 256, (64, 96, 3)).astype(np.uint8)
    return save(tmp_path / f"{seed}.jpg", noise).read_bytes()


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_a_jpeg_cut_in_its_scan_with_its_end_marker_is_refused(tmp_path: Path, kept: float):
    content = jpeg(tmp_path)
    start = content.rfind(b"\xff\xda")
    rest = content[start : start + int(kept * (len(content) - start))]
    (tmp_path / "cut.jpg").write_bytes(content[:start] + rest + b"\xff\xd9")
    with pytest.raises(InputError, match=r"cut\.jpg"):
        read_color(tmp_path / "cut.jpg")


def test_a_jpeg_with_flipped_bytes_is_refused_or_warned_of(tmp_path: Path):
    whole, silent = jpeg(tmp_path), 0
    for seed in range(20):
        content, rng = bytearray(whole), np.random.default_rng(seed)
        for place in rng.integers(whole.rfind(b"\xff\xda") + 20, len(whole) - 2, 5):
            content[place] ^= 0x55
        (tmp_path / "flipped.jpg").write_bytes(content)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                read_color(tmp_path / "flipped.jpg")
                silent += not any("flipped.jpg may be damaged" in str(w.message) for w in said)
            except InputError:
                pass
    assert silent <= 2  # a flip can give another whole image, which nobody can tell


def test_what_a_decoder_says_stays_off_the_screen(tmp_path: Path, capfd):
    content = jpeg(tmp_path)
    (tmp_path / "padded.jpg").write_bytes(content[:-2] + bytes(8) + content[-2:])
    with pytest.warns(UserWarning, match=r"padded\.jpg may be damaged: .* extraneous bytes"):
        image = read_color(tmp_path / "padded.jpg")
    np.testing.assert_array_equal(image, read_color(tmp_path / "0.jpg"))
    assert capfd.readouterr().err == ""


def test_images_are_read_where_a_pipe_always_waits(tmp_path: Path, monkeypatch):
    monkeypatch.delattr("os.set_blocking", raising=False)  # as in Python 3.11 on Windows
    jpeg(tmp_path)
    assert read_color(tmp_path / "0.jpg").dtype == np.uint8


def test_images_are_read_where_standard_error_takes_nothing(tmp_path: Path, monkeypatch):
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    jpeg(tmp_path)
    monkeypatch.setattr("os.write", full)
    assert read_color(tmp_path / "0.jpg").dtype == np.uint8


def png_chunk(kind: bytes, data: bytes, checksum: int | None = None) -> bytes:
    checksum = zlib.crc32(kind + data) if checksum is None else checksum
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


@pytest.mark.parametrize(
    "note",
    [
        2 * png_chunk(b"gAMA", struct.pack(">I", 45455)),  # twice
        png_chunk(b"iCCP", b"icc\0\0" + zlib.compress(bytes(200))),  # no profile
        png_chunk(b"tEXt", b"Author\0me", checksum=5),  # a wrong one
    ],
    ids=["gamma", "profile", "text"],
)
def test_a_png_whose_notes_are_wrong_is_a_whole_picture(note: bytes, tmp_path: Path, capfd):
    content = save(tmp_path / "a.png", picture(0)).read_bytes()
    (tmp_path / "noted.png").write_bytes(content[:33] + note + content[33:])
    np.testing.assert_array_equal(read_color(tmp_path / "noted.png"), picture(0))
    assert capfd.readouterr().err == ""


def test_fill_bytes_may_precede_a_marker(tmp_path: Path):
    photo = cv2.imencode(".jpg", picture(0, 32, 24))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(photo[:2] + b"\xff" * 3 + photo[2:])
    assert read_color(tmp_path / "a.jpg").shape == (24, 32, 3)
    assert noted_size(tmp_path / "a.jpg") == (32, 24)


def test_a_picture_of_another_format_is_to_be_converted(tmp_path: Path):
    (tmp_path / "a.jpg").write_bytes(cv2.imencode(".webp", picture(0))[1].tobytes())
    with pytest.raises(
        InputError, match=r"a\.jpg .* is of another format than its name says; conv"
    ):
        read_color(tmp_path / "a.jpg")


THREADS = """
import os, sys, threading, time
from pathlib import Path
from minislam.data.images import read_color

def read():
    for _ in range(20):
        read_color(Path(sys.argv[1]))

def log():
    while readers[0].is_alive():
        os.write(2, b"a line" + os.linesep.encode())
        time.sleep(0.001)

readers = [threading.Thread(target=read) for _ in range(2)]
for thread in (*readers, threading.Thread(target=log)):
    thread.start()
"""


def test_two_threads_read_while_a_third_writes_a_log(tmp_path: Path):
    path = save(tmp_path / "a.jpg", picture(0, 320, 240))
    command = [sys.executable, "-c", THREADS, str(path)]
    done = subprocess.run(command, capture_output=True, timeout=60, text=True)
    assert {*done.stderr.splitlines()} <= {"a line"}, done.stderr


def test_a_png_with_a_flipped_byte_in_its_pixels_is_refused(tmp_path: Path):
    content = bytearray(save(tmp_path / "a.png", picture(0)).read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png .* is damaged"):
        read_color(tmp_path / "a.png")


def test_a_header_that_claims_ten_giga_pixels_is_refused(tmp_path: Path):
    content = bytearray(save(tmp_path / "a.png", picture(0)).read_bytes())
    content[16:24] = struct.pack(">II", 100_000, 100_000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png .* is damaged"):
        read_color(tmp_path / "a.png")


def test_colour_is_no_depth(tmp_path: Path):
    with pytest.raises(InputError, match="16-bit single-channel"):
        read_depth(save(tmp_path / "c.png", picture(0)), 5000)
