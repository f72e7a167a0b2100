"""What a file notes: the size of an image; the focal length, by EXIF or the tags of QuickTime.

Photos (JPEG) name the equivalent on 35 mm film, or else the focal length and the pixels per inch
of the sensor. iPhone videos name the equivalent; most other videos name nothing. Equivalents are
whole millimetres, and stabilisation crops the image, so that all this is a first guess.
"""

import math
import struct
from collections.abc import Iterator
from contextlib import suppress
from mmap import ACCESS_READ, mmap
from pathlib import Path

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm; equivalents keep the field of view of the diagonal
VIDEO_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
POSSIBLE = (0.2, 20.0)  # image diagonals, of a focal length that is believed

# Tags of EXIF
_POINTER, _FILM_EQUIVALENT, _FOCAL_LENGTH, _RESOLUTION, _UNIT, _WIDTH, _HEIGHT, _ORIENTATION = (
    0x8769, 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003, 0x0112,
)  # fmt: skip
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of a unit of resolution
_EXIF_NUMBERS = {3: "H", 4: "I", 5: "II"}  # struct codes: short, long, rational
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"  # the first bytes
_APP1, _SIZES = 0xE1, {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of JPEG's segments
_UNREADABLE = (
    OSError, struct.error, LookupError, ValueError, ArithmeticError, RecursionError, StopIteration
)  # fmt: skip
_VIDEO_NUMBERS = {21: ">i", 22: ">I", 67: ">i", 77: ">I", 66: ">h", 76: ">H", 23: ">f", 24: ">d"}


def noted_focal_length(path: Path) -> tuple[float, str] | None:
    """Return the focal length over the image diagonal and its origin; None if none is noted."""
    try:
        content = _mapped(path)
        is_photo = content[:2] == JPEG
        found = _of_exif(_exif(content)) if is_photo else next(_of_video(content))
    except _UNREADABLE:
        return None  # Damaged notes are no reason to refuse whole images.
    origin = f"{'EXIF' if is_photo else 'QuickTime tag'} of {path.name}"
    return (found, origin) if POSSIBLE[0] < found < POSSIBLE[1] else None


def noted_size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) px of an image file as it is decoded, upright; None if not noted."""
    try:
        content = _mapped(path)
        if content[:8] == PNG:
            return struct.unpack_from(">II", content, 16)
        if content[:2] != JPEG:
            return None
        frame = next(segment for marker, segment in _segments(content) if marker in _SIZES)
        height, width = struct.unpack_from(">HH", frame, 1)
    except _UNREADABLE:
        return None
    with suppress(*_UNREADABLE):
        if _tags(_exif(content)).get(_ORIENTATION, 1) >= 5:  # the camera was held upright
            return height, width
    return width, height


def _mapped(path: Path) -> memoryview:
    with path.open("rb") as file:
        return memoryview(mmap(file.fileno(), 0, access=ACCESS_READ))


def _segments(photo: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield marker and content of the segments in the header of a JPEG file."""
    at = 2
    while photo[at] == 0xFF:
        if photo[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        (length,) = struct.unpack_from(">H", photo, at + 2)
        yield photo[at + 1], photo[at + 4 : at + 2 + length]
        at += 2 + length


def _exif(photo: memoryview) -> memoryview:
    """Return the TIFF structure of a JPEG file; StopIteration if it has none."""
    headers = (segment for marker, segment in _segments(photo) if marker == _APP1)
    return next(header[6:] for header in headers if header[:6] == b"Exif\0\0")


def _tags(tiff: memoryview, within: int | None = None) -> dict[int, float]:
    """Return the numbers of the first directory, or of the one that a tag of it points to."""
    order = {b"II": "<", b"MM": ">"}[bytes(tiff[:2])]
    (at,) = struct.unpack_from(f"{order}I", tiff, 4)
    if within is not None:
        at = int(_tags(tiff)[within])
    values = {}
    for entry in range(struct.unpack_from(f"{order}H", tiff, at)[0]):
        tag, kind, count, place = struct.unpack_from(f"{order}HHII", tiff, at + 2 + 12 * entry)
        if kind in _EXIF_NUMBERS and count == 1:
            start = place if kind == 5 else at + 10 + 12 * entry
            number, *divisor = struct.unpack_from(order + _EXIF_NUMBERS[kind], tiff, start)
            values[tag] = number / (divisor[0] or math.inf) if divisor else number
    return values


def _of_exif(tiff: memoryview) -> float:
    """Return the focal length over the image diagonal."""
    found = _tags(tiff, within=_POINTER)
    if found.get(_FILM_EQUIVALENT):
        return found[_FILM_EQUIVALENT] / FILM_DIAGONAL
    per_millimetre = found[_RESOLUTION] / _MILLIMETRES[int(found.get(_UNIT, 2))]
    return found[_FOCAL_LENGTH] * per_millimetre / math.hypot(found[_WIDTH], found[_HEIGHT])


def _boxes(content: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and content of the boxes in a video, or in one of its boxes."""
    while len(content) >= 8:
        size, kind = struct.unpack_from(">I4s", content)
        start = 16 if size == 1 else 8
        if size < 2:  # 1: it stands behind the kind; 0: the box is the last
            size = struct.unpack_from(">Q", content, 8)[0] if size else len(content)
        if size < start:
            return
        yield kind, content[start:size]
        content = content[size:]


def _of_video(video: memoryview) -> Iterator[float]:
    """Yield each focal length over the image diagonal that a box, or one inside it, notes."""
    for kind, content in _boxes(video):
        if kind in (b"moov", b"trak", b"udta"):
            yield from _of_video(content)
        elif kind == b"meta":
            # ISO files have four bytes of version in front of the boxes, QuickTime has none.
            inner = dict(_boxes(content if content[4:8] == b"hdlr" else content[4:]))
            names = [bytes(name) for _, name in _boxes(inner.get(b"keys", content[:0])[8:])]
            if VIDEO_KEY in names:
                place = struct.pack(">I", names.index(VIDEO_KEY) + 1)  # values go by position
                ((_, value),) = _boxes(dict(_boxes(inner[b"ilst"]))[place])
                number = _VIDEO_NUMBERS[struct.unpack_from(">I", value)[0]]
                yield struct.unpack_from(number, value, 8)[0] / FILM_DIAGONAL
