"""Moving pictures that browsers play: WebM video (VP8) and animated WebP, both by OpenCV."""

import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from minislam.data.files import atomic_write
from minislam.errors import InputError

_WEBP_QUALITY = 75  # of 100


def write_animation(path: Path | str, images: Iterable[np.ndarray], rate: float) -> None:
    """Write images (H, W, 3) RGB in [0, 1], `rate` per second, as .webm or .webp.

    The images may come one by one: a video holds only one of them in memory.
    """
    kind = Path(path).suffix.lower()
    encoders = {".webm": _write_webm, ".webp": _write_webp}
    if kind not in encoders:
        raise InputError(f"expected a file that ends in .webm or .webp, found {kind or 'neither'}")
    frames = (np.round(255 * np.clip(i, 0, 1)[..., ::-1]).astype(np.uint8) for i in images)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"animation{kind}"
        encoders[kind](file, frames, rate)
        if not file.is_file() or not (content := file.read_bytes()):
            raise InputError(
                f"expected this OpenCV ({cv2.__version__}) to write {kind}, but it does not; "
                "choose the other kind, .webm or .webp, or install a newer one"
            )
    atomic_write(path, content)


def _write_webm(file: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    writer = None
    for frame in frames:
        if writer is None:
            code = cv2.VideoWriter.fourcc(*"VP80")
            writer = cv2.VideoWriter(str(file), code, rate, (frame.shape[1], frame.shape[0]))
        writer.write(frame)
    if writer is not None:
        writer.release()


def _write_webp(file: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    animation = cv2.Animation()
    animation.frames = list(frames)
    animation.durations = [round(1000 / rate)] * len(animation.frames)  # ms
    if len(animation.frames):
        cv2.imwriteanimation(str(file), animation, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
