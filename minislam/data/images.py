"""Decode the image files that cameras write; encode PNG, JPEG and animations."""

import os
import re
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock

import cv2
import numpy as np

from minislam.data.files import atomic_write, read_bytes
from minislam.data.metadata import JPEG, PNG
from minislam.errors import InputError, require

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_ROOM = 1 << 16  # bytes that are left over on a disk that has held a whole animation
_WEBP_QUALITY = 75  # of 100
_JPEG_QUALITY = 85  # of 100: without visible blocks, a tenth of the bytes of a PNG
_JPEG_START_OF_SCAN, _JPEG_END_OF_IMAGE = b"\xff\xda", b"\xff\xd9"
_STDERR = Lock()  # file descriptor 2 belongs to the whole process
_OF_CODECS = re.compile(rb"JPEG|JFIF|SOS|Adobe|progression|scanlines|libpng")  # in their lines
_OF_FFMPEG = re.compile(rb"FFMPEG")


def is_image(path: Path) -> bool:
    """Tell by its name whether a file is an image; hidden files never are."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def natural_key(name: str) -> list[str | int]:  # text and numbers in turns
    """Return a sort key that puts frame9 before frame10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def is_number(name: str) -> bool:
    """Tell whether a name is a number, as a time or a count."""
    return re.fullmatch(r"\d+(\.\d+)?", name, re.ASCII) is not None


def is_text(name: str) -> bool:
    """Tell whether a file name is text: OpenCV crashes at one with other bytes."""
    return re.search("[\ud800-\udfff]", name) is None


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder in their order; none of a folder that is not there."""
    entries = folder.iterdir() if folder.is_dir() else ()
    images = [path for path in entries if is_image(path) and path.is_file()]
    if all(is_number(path.stem) for path in images):  # 0.15 stands before 0.2
        return sorted(images, key=lambda path: (float(path.stem), path.name))
    return sorted(images, key=lambda path: (natural_key(path.name), path.name))


def read_color(path: Path) -> np.ndarray:  # (H, W, 3) uint8 RGB
    """Read any image as 8-bit RGB without alpha, upright as the EXIF header of phones says."""
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_mask(path: Path) -> np.ndarray:  # (H, W) bool
    """Read a black and white image: what is white and not transparent is True."""
    gray = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if path.suffix.lower() == ".png":
        alpha = _decode(path, cv2.IMREAD_UNCHANGED).reshape(*gray.shape, -1)[..., 3:]
        gray = np.minimum(gray, alpha[..., 0]) if alpha.size else gray
    white = 255 if gray.max() <= 255 else 65535
    found = f"{gray.max()} as the largest value in {path}"
    advice = f"write {white} where something moves, not its number"
    is_mask = gray.max() == 0 or gray.max() > white // 2
    require(is_mask, f"a mask of 0 and {white}", f"{found}; {advice}")
    return gray > white // 2


def read_depth(path: Path, units_per_metre: float) -> np.ndarray:  # (H, W) float32 metre
    """Read a 16-bit depth image, 0 where unknown. TUM files store 5000 units per metre."""
    depth = _decode(path, cv2.IMREAD_UNCHANGED)
    is_depth = depth.ndim == 2 and depth.dtype == np.uint16
    found = f"{depth.dtype} of shape {depth.shape} in {path}; export depth as 16-bit PNG"
    require(is_depth, "a 16-bit single-channel depth image", found)
    return depth.astype(np.float32) / np.float32(units_per_metre)


def encode_png(image: np.ndarray) -> bytes:
    """Return PNG bytes of (H, W, 3) RGB or (H, W), either float in [0, 1], uint8 or uint16."""
    return cv2.imencode(".png", _bgr(image))[1].tobytes()


def encode_jpeg(image: np.ndarray, longest: int) -> bytes:
    """Return JPEG bytes of (H, W, 3) RGB in [0, 1], made smaller if a side exceeds `longest` px."""
    image = _bgr(image)
    scale = longest / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def write_animation(path: Path | str, images: Iterable[np.ndarray], rate: float) -> None:
    """Write images (H, W, 3) RGB in [0, 1], `rate` per second, as .webm (one by one) or .webp."""
    kind = Path(path).suffix.lower()
    encoders = {".webm": _write_webm, ".webp": _write_webp}
    found = f"{kind or 'neither'}; write .webm, and convert that with ffmpeg if you need .mp4"
    require(kind in encoders, "a file that ends in .webm or .webp", found)
    with tempfile.TemporaryDirectory() as folder:
        found = f"{folder!a}; set TMPDIR to another folder"
        require(is_text(folder), "a temporary folder whose name is text", found)
        file = Path(folder) / f"animation{kind}"
        encoders[kind](file, map(_bgr, images), rate)
        _require_room(folder)
        if not file.is_file() or not (content := file.read_bytes()):
            found = f"OpenCV {cv2.__version__}, which cannot, or has no space in {folder}"
            advice = "choose .webm or .webp, the other one, or set TMPDIR to another folder"
            raise InputError(f"expected an OpenCV that writes {kind}, found {found}; {advice}")
    atomic_write(path, content)


def _require_room(folder: str) -> None:
    """Refuse an animation on a full disk, where the encoders cut it short and say nothing."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_ROOM))
    except OSError as error:
        reason = f"{error.strerror}; free space, or set TMPDIR to another folder"
        raise InputError(f"expected space for an animation in {folder}, but: {reason}") from error


def _write_webm(file: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    writer, code = cv2.VideoWriter(), cv2.VideoWriter.fourcc(*"VP80")
    for frame in frames:
        if not writer.isOpened():
            with _off_screen(_OF_FFMPEG):  # where FFmpeg says that WebM has another code for VP8
                writer.open(str(file), code, rate, (frame.shape[1], frame.shape[0]))
        writer.write(frame)
    writer.release()


def _write_webp(file: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    animation = cv2.Animation()
    animation.frames = list(frames)
    animation.durations = [round(1000 / rate)] * len(animation.frames)  # ms
    if len(animation.frames):
        cv2.imwriteanimation(str(file), animation, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])


def _bgr(image: np.ndarray) -> np.ndarray:
    """Return an image as OpenCV encodes it; floats in [0, 1] become bytes, NaN becomes 0."""
    if image.dtype.kind == "f":
        image = np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)


def _decode(path: Path, mode: int) -> np.ndarray:
    content, decoded = read_bytes(path), None
    # OpenCV raises an error at a header that claims 10^10 px.
    with _off_screen(_OF_CODECS) as lines, suppress(cv2.error):
        if _is_complete(content):
            decoded = cv2.imdecode(np.frombuffer(content, np.uint8), mode)
    # Only here libjpeg reports damage. What libpng only warns of, such as a broken colour profile,
    # does not touch the pixels.
    said = b"".join(line for line in lines if not line.startswith(b"libpng warning"))
    if b"extraneous" in said:  # cameras pad some files so, and damage looks like it, too
        warnings.warn(f"{path} may be damaged: {said.decode().strip()}", stacklevel=1)
    elif said:
        decoded = None  # libjpeg has filled the rest with grey
    if decoded is None:
        is_other = content and not content.startswith((PNG, JPEG))
        fault = "of another format than its name says; convert" if is_other else "damaged; replace"
        found = f"{path} ({len(content)} bytes) is {fault} or remove it"
        raise InputError(f"expected a whole PNG or JPEG image, but {found}")
    return decoded


def _is_complete(content: bytes) -> bool:
    """Tell whether the end marker is there; without it some decoders fill the rest with grey."""
    if content.startswith(PNG):
        return b"IEND" in content
    if content.startswith(JPEG):
        # A thumbnail in the header has its own end marker, a film that phones append any bytes.
        at = 2  # behind the start marker; then one segment of the header after the other
        while content[at : at + 1] == b"\xff" and content[at : at + 2] != _JPEG_START_OF_SCAN:
            is_fill = content[at + 1 : at + 2] == b"\xff"  # any number may precede a marker
            at += 1 if is_fill else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        return content.find(_JPEG_END_OF_IMAGE, at) > 0
    return False


@contextmanager
def _off_screen(pattern: re.Pattern[bytes]) -> Iterator[list[bytes]]:
    """Keep lines of C libraries off standard error; afterwards yield them. Others go there."""
    with _STDERR:
        reader, writer = os.pipe()
        if hasattr(os, "set_blocking"):  # Windows has it from Python 3.12 on
            os.set_blocking(reader, False)  # another process may have inherited the other end
            os.set_blocking(writer, False)  # what does not fit is dropped, rather than waited for
        before, kept = os.dup(2), list[bytes]()
        os.dup2(writer, 2)
        try:
            yield kept
        finally:
            os.dup2(before, 2)
            os.close(before)
            os.close(writer)
            with suppress(OSError):  # nothing was said, or standard error takes nothing
                lines = os.read(reader, 1 << 16).splitlines(keepends=True)
                kept += filter(pattern.search, lines)
                os.write(2, b"".join(line for line in lines if not pattern.search(line)))
            os.close(reader)
