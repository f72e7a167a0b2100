"""The focal length and the size that photos and videos note, in files made byte by byte."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from minislam.data.images import encode_jpeg, encode_png, read_color
from minislam.data.metadata import VIDEO_KEY, noted_focal_length, noted_size

DIAGONAL = math.hypot(36, 24)  # mm, of 35 mm film
SHORT, LONG, RATIONAL = 3, 4, 5
PNG = encode_png(np.zeros((2, 2)))


def exif(tags: dict[int, tuple[int, object]], order: str = "<") -> bytes:
    """Return a JPEG header with an EXIF segment that holds these tags, as (type, value)."""
    after = 8 + 18 + 2 + 12 * len(tags) + 4  # where the rationals lie
    entries, rationals = b"", b""
    for tag, (kind, value) in sorted(tags.items()):
        if kind == RATIONAL:
            place = struct.pack(f"{order}I", after + len(rationals))
            rationals += struct.pack(f"{order}II", *value)
        else:
            place = struct.pack(order + {SHORT: "Hxx", LONG: "I"}[kind], value)
        entries += struct.pack(f"{order}HHI", tag, kind, 1) + place
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    tiff += struct.pack(f"{order}HHHIII", 1, 0x8769, LONG, 1, 26, 0)
    tiff += struct.pack(f"{order}H", len(tags)) + entries + bytes(4) + rationals
    segment = b"Exif\0\0" + tiff
    other = b"\xff\xe0" + struct.pack(">H", 6) + b"JFIF"
    return b"\xff\xd8" + other + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def movie(number: bytes, kind: int, in_track: bool = False, version: bytes = b"") -> bytes:
    """Return a video without images whose second key is the focal length."""
    keys = box(b"mdta", b"com.apple.quicktime.make") + box(b"mdta", VIDEO_KEY)
    make = box(struct.pack(">I", 1), box(b"data", struct.pack(">II", 1, 0) + b"Apple"))
    value = box(struct.pack(">I", 2), box(b"data", struct.pack(">II", kind, 0) + number))
    parts = box(b"hdlr", bytes(24)) + box(b"keys", struct.pack(">II", 0, 2) + keys)
    meta = box(b"meta", version + parts + box(b"ilst", make + value))
    inside = box(b"trak", meta) if in_track else meta
    images = struct.pack(">I4sQ", 1, b"mdat", 16 + 1000) + bytes(1000)  # a size of 64 bits
    return box(b"ftyp", b"qt  ") + images + box(b"moov", box(b"mvhd", bytes(100)) + inside)


def noted(tmp_path: Path, content: bytes) -> tuple[float, str] | None:
    path = tmp_path / "camera.file"
    path.write_bytes(content)
    return noted_focal_length(path)


# Known answers


@pytest.mark.parametrize("order", "<>")
def test_a_photo_names_its_equivalent_on_film(order: str, tmp_path: Path):
    photo = exif({0xA405: (SHORT, 26), 0x920A: (RATIONAL, (42, 10))}, order)
    assert noted(tmp_path, photo) == (pytest.approx(26 / DIAGONAL), "EXIF of camera.file")


def test_a_photo_names_the_pixels_of_its_sensor(tmp_path: Path):
    # 35 mm x 5000 px per inch / 25.4 mm per inch = 6890 px, of a diagonal of 5000 px.
    tags = {
        0xA405: (SHORT, 0),  # unknown
        0x920A: (RATIONAL, (35, 1)),
        0xA20E: (RATIONAL, (10_000_000, 2000)),
        0xA210: (SHORT, 2),
        0xA002: (LONG, 4000),
        0xA003: (LONG, 3000),
    }
    found, _ = noted(tmp_path, exif(tags))
    assert found == pytest.approx(35 * 5000 / 25.4 / 5000)


@pytest.mark.parametrize(
    ("number", "kind"),
    [(struct.pack(">i", 26), 67), (struct.pack(">i", 26), 21), (struct.pack(">f", 26), 23)],
)
@pytest.mark.parametrize("in_track", [False, True])
def test_a_video_names_its_equivalent_on_film(number, kind, in_track, tmp_path: Path):
    found = noted(tmp_path, movie(number, kind, in_track))
    assert found == (pytest.approx(26 / DIAGONAL), "QuickTime tag of camera.file")
    as_iso = noted(tmp_path, movie(number, kind, in_track, version=bytes(4)))
    assert as_iso == found
    before, moov, after = movie(number, kind, in_track).partition(b"moov")
    assert noted(tmp_path, before[:-4] + bytes(4) + moov + after) == found  # 0: up to the end


# Files that say nothing


def test_what_is_cut_short_or_damaged_says_nothing(tmp_path: Path):
    whole = [exif({0xA405: (SHORT, 26)}), movie(struct.pack(">i", 26), 67)]
    for content in whole:
        for length in range(0, len(content), 7):
            noted(tmp_path, content[:length])  # no error, whatever it says
            spoilt = bytearray(content)
            spoilt[length] ^= 0xFF
            noted(tmp_path, bytes(spoilt))
        assert noted(tmp_path, content[: len(content) // 2]) is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        b"\xff\xd8\xff\xda" + bytes(50),
        exif({0x920A: (RATIONAL, (35, 1))}),
        exif({0xA405: (SHORT, 60_000)}),
        box(b"ftyp", b"isom") + box(b"moov", box(b"mvhd", bytes(100))),
        b"".join(struct.pack(">I4s", 8 * left, b"moov") for left in range(3000, 0, -1)),  # nested
    ],
)
def test_a_file_without_a_possible_focal_length_says_nothing(content: bytes, tmp_path: Path):
    assert noted(tmp_path, content) is None


def test_a_file_that_is_not_there_says_nothing(tmp_path: Path):
    assert noted_focal_length(tmp_path / "none.mp4") is None


@pytest.mark.parametrize(("orientation", "size"), [(None, (31, 20)), (3, (31, 20)), (6, (20, 31))])
def test_a_photo_notes_its_size_as_it_is_decoded(orientation, size, tmp_path: Path):
    photo = encode_jpeg(np.zeros((20, 31, 3)), 31)
    if orientation:
        tiff = struct.pack("<2sHIHHHIHxxI", b"II", 42, 8, 1, 0x0112, SHORT, 1, orientation, 0)
        photo = _with_segment(photo, b"Exif\0\0" + tiff)
    path = tmp_path / "photo.jpg"
    path.write_bytes(photo)
    assert noted_size(path) == size
    assert read_color(path).shape[1::-1] == size


def test_a_picture_notes_its_size(tmp_path: Path):
    (path := tmp_path / "a.png").write_bytes(encode_png(np.zeros((20, 31))))
    assert noted_size(path) == (31, 20)


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\xff\xd8", b"\xff\xd8\xff\xc0\x00\x08", PNG[:17]]
)
def test_of_a_damaged_picture_no_size_is_known(content: bytes, tmp_path: Path):
    (path := tmp_path / "a.jpg").write_bytes(content)
    assert noted_size(path) is None


def _with_segment(photo: bytes, segment: bytes) -> bytes:
    return photo[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + photo[2:]
