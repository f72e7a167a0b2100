"""Film as a phone does: lines one after the other, blurred, in a light that drifts, upright.

A phone reads its sensor line by line, each line sees the world at a time of its own ("rolling
shutter"), and exposes it for a while ("motion blur"). It sets exposure and white balance anew in
each frame. Held upright, its lines run from top to bottom and are read from left to right.

The true pose, depth and mask of a frame are those of its middle line, in the middle of the time
that this line is exposed.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from .errors import SynthError
from .poses import Array, Intrinsics, default_intrinsics
from .render import SUPERSAMPLE, average, camera_rays, ray_colours, through_lens
from .scenes import Scene

DRIFT_SECONDS = 2.4  # s, in which exposure and white balance swing once
_MATRIX_AT = 44  # bytes from the name of the box tkhd, version 0, to its matrix
_QUARTER_TURN = (0, 1, -1, 0)  # a, b, c, d of the matrix: players turn the frames to the right


@dataclass(frozen=True)
class Phone:
    """What a phone does to the images; nothing of it where all numbers are zero."""

    readout: float = 0.02  # s, from the first line of the sensor to the last
    shutter: float = 0.01  # s, for which each line is exposed
    exposure: float = 0.25  # stops up and down: the light swings by the factor 2**exposure
    white: float = 0.08  # red gains and blue loses this part, and the other way round
    subframes: int = 3  # times at which the light of a line is gathered, if it is exposed at all
    band: int = 4  # lines that are read at one time; 1 is exact, and slow
    calibrated: bool = False  # whether the focal length is written beside the images

    def __post_init__(self) -> None:
        if min(self.readout, self.shutter, self.exposure, self.white) < 0 or self.white >= 1:
            raise SynthError(f"a phone has no negative times or gains, and white below 1: {self}")
        if min(self.subframes, self.band) < 1:
            raise SynthError(f"a phone needs at least one subframe and lines of 1 px: {self}")

    def gains(self, time: float) -> Array:  # (3,)
        """Return by which factors red, green and blue are multiplied at a time [s]."""
        angle = 2 * np.pi * time / DRIFT_SECONDS
        light = 2.0 ** (self.exposure * np.sin(angle))
        warmth = self.white * np.sin(0.7 * angle + 1.0)
        return np.array([light * (1 + warmth), light, light * (1 - warmth)])


def phone_intrinsics(size: tuple[int, int]) -> Intrinsics:
    """Return the camera for images (width, height): upright ones are the same sensor, turned."""
    width, height = size
    if width >= height:
        return default_intrinsics(size)
    lying = default_intrinsics((height, width))
    return replace(lying, cx=lying.cy, cy=lying.cx, width=width, height=height)


def film(
    view: Scene,
    intrinsics: Intrinsics,
    time: float,  # s, in the middle of the middle line's exposure
    phone: Phone,
) -> Array:  # (h, w, 3) float32 in [0, 1], without noise
    """Return what a phone films of a scene at a time; truth poses are `view.path(time)`."""
    image = np.zeros((intrinsics.height, intrinsics.width, 3), np.float32)
    shares = (np.arange(phone.subframes) + 0.5) / phone.subframes - 0.5
    moments = phone.shutter * shares if phone.shutter else np.zeros(1)
    for lines, camera, delay in _bands(intrinsics, phone):
        for moment in time + delay + moments:
            image[lines] += _photograph(view, moment, camera) / np.float32(len(moments))
    return np.clip(through_lens(image) * phone.gains(time).astype(np.float32), 0, 1)


def _photograph(view: Scene, time: float, intrinsics: Intrinsics) -> Array:
    """Return the image of one moment, (h, w, 3) float32, and none of the truth beside it."""
    rays = camera_rays(intrinsics, view.path(time), SUPERSAMPLE, np.float32)
    image, _ = ray_colours(view.room.parts, view.mover_parts(time), view.room.lamp, rays)
    return average(image, intrinsics)


def _bands(
    intrinsics: Intrinsics, phone: Phone
) -> Iterable[tuple[tuple[slice, slice], Intrinsics, float]]:
    """Yield the lines that are read at one time, the camera that sees only them, and their delay.

    The delay [s] counts from the middle of the sensor.
    """
    everything = slice(None)
    if not phone.readout:
        yield (everything, everything), intrinsics, 0.0
        return
    is_upright = intrinsics.height > intrinsics.width
    count = intrinsics.width if is_upright else intrinsics.height
    for first in range(0, count, phone.band):
        last = min(first + phone.band, count)
        delay = phone.readout * ((first + last) / (2 * count) - 0.5)
        if is_upright:
            camera = replace(intrinsics, cx=intrinsics.cx - first, width=last - first)
            yield (everything, slice(first, last)), camera, delay
        else:
            camera = replace(intrinsics, cy=intrinsics.cy - first, height=last - first)
            yield (slice(first, last), everything), camera, delay


def write_video(path: Path | str, frames: Iterable[Array], rate: float, turned: bool) -> None:
    """Write frames (h, w, 3) uint8 RGB as MP4; it notes no focal length.

    Turned: the frames are stored lying, as a sensor sees them, with a note that players have to
    turn them upright. That is what a phone writes.
    """
    writer = None
    for frame in frames:
        stored = np.rot90(frame) if turned else frame
        if writer is None:
            code = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]
            writer = cv2.VideoWriter(str(path), code, rate, stored.shape[1::-1])
            if not writer.isOpened():
                raise SynthError(f"could not write {path}: this OpenCV writes no MP4 there")
        writer.write(np.ascontiguousarray(stored[..., ::-1]))
    if writer is None:
        raise SynthError("a video needs at least 1 frame")
    writer.release()
    if turned:
        content = bytearray(Path(path).read_bytes())
        a, b, c, d = (n << 16 for n in _QUARTER_TURN)
        matrix = (a, b, 0, c, d, 0, 0, 0, 1 << 30)
        struct.pack_into(">9i", content, content.rindex(b"tkhd") + _MATRIX_AT, *matrix)
        Path(path).write_bytes(content)
