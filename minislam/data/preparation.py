"""From the raw image to the working image: undistort, cut unseen borders, resize, crop, keep."""

from dataclasses import asdict

import cv2
import numpy as np

from minislam.data.options import MINIMUM_SIDE
from minislam.data.picture import Window
from minislam.errors import InputError, require
from minislam.geometry import BrownDistortion, Camera

# The tracker's grid, classical or DROID's, has cells of 8 px, so sides that are chosen here are
# multiples of it; those of --size may be any.
SIZE_MULTIPLE = 8  # px


class ImagePreparation:
    """Turns raw images of one size into working images, all of them by the same steps.

    The camera goes through the same steps exactly. Depth and masks are moved without blending:
    the mean of two depths is a surface that does not exist.
    """

    def __init__(
        self,
        raw_camera: Camera,
        distortion: BrownDistortion,
        size: tuple[int, int] | None,  # (width, height) px of the working image, None: choose
        pixels: int,  # about width * height of the working image when it is chosen
        picture: Window | None = None,  # of the raw image, see picture.py; None: all
    ) -> None:
        self.raw_camera, self._raw_size = raw_camera, (raw_camera.width, raw_camera.height)
        wanted = f"images of at least {MINIMUM_SIDE}x{MINIMUM_SIDE} px"
        found = f"{raw_camera.width}x{raw_camera.height}; use larger images"
        require(min(self._raw_size) >= MINIMUM_SIDE, wanted, found)
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self._window = picture or (0, 0, *self._raw_size)
        if np.any(distortion.coefficients):
            self._maps = distortion.undistortion_maps(raw_camera)
            self._window = seen_window(*self._maps, self._window)
        seen_width, seen_height = self._window[2:]
        width, height = size or working_size(seen_width, seen_height, pixels)
        # The smallest scale at which the image covers the wanted size; the rest is cropped.
        scale = max(width / seen_width, height / seen_height)
        columns, rows = round(scale * seen_width), round(scale * seen_height)
        self._resized = max(columns, width), max(rows, height)
        self._crop = (self._resized[0] - width) // 2, (self._resized[1] - height) // 2
        resized = raw_camera.cropped(*self._window).resized(*self._resized)
        self.camera = resized.cropped(*self._crop, width, height)
        self.steps: dict[str, object] = {  # from raw to working images, in order, in pixels
            "raw_camera": asdict(raw_camera),
            "distortion": asdict(distortion),
            "window": self._window,  # left, top, width, height of the undistorted image
            "resized": self._resized,  # width, height
            "crop": self._crop,  # left, top
        }

    def color(self, raw: np.ndarray, label: str = "an image") -> np.ndarray:  # (H', W', 3) float32
        """Prepare a colour image: values in [0, 1]."""
        return self.pixels(raw, label).astype(np.float32) / np.float32(255)

    def pixels(self, raw: np.ndarray, label: str) -> np.ndarray:  # (H', W', 3) uint8
        """Prepare a colour image (H, W, 3) uint8; an error calls it by its label."""
        image = self.undistort(raw, label)
        if (image.shape[1], image.shape[0]) != self._resized:
            image = cv2.resize(image, self._resized, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(self._cropped(image))

    def full_camera(self, camera: Camera) -> Camera:
        """Return the camera of an undistorted image from that of the working image."""
        left, top = self._crop
        return camera.cropped(-left, -top, *self._resized).resized(*self._window[2:])

    def nearest(self, raw: np.ndarray, label: str = "an image") -> np.ndarray:  # (H', W')
        """Prepare a depth image or a mask (H, W): every value is one of the raw values."""
        as_numbers = raw.astype(np.uint8) if raw.dtype == bool else raw
        image = self.undistort(as_numbers, label, cv2.INTER_NEAREST)
        # cv2's nearest neighbour is off by up to half a pixel; these are the true centres.
        columns, rows = (
            ((np.arange(new) + 0.5) * old / new).astype(int)
            for new, old in zip(self._resized, self._window[2:], strict=True)
        )
        return np.ascontiguousarray(self._cropped(image[rows][:, columns])).astype(raw.dtype)

    def undistort(
        self, raw: np.ndarray, label: str, interpolation: int = cv2.INTER_LINEAR
    ) -> np.ndarray:  # (H, W, ...)
        """Undistort an image and cut unseen borders, at the size of the source."""
        width, height = self._raw_size
        wanted = f"images of one size, {width}x{height} as the first"
        advice = "remove or resize the odd ones" if raw.ndim == 3 else "resize depth and masks"
        found = f"{raw.shape[1]}x{raw.shape[0]} in {label}; {advice}"
        require(raw.shape[:2] == (height, width), wanted, found)
        if self._maps is not None:
            raw = cv2.remap(raw, *self._maps, interpolation)
        left, top, width, height = self._window
        return raw[top : top + height, left : left + width]

    def _cropped(self, image: np.ndarray) -> np.ndarray:
        left, top = self._crop
        return image[top : top + self.camera.height, left : left + self.camera.width]


def working_size(width: int, height: int, pixels: int) -> tuple[int, int]:
    """Choose a working size: the same aspect, about `pixels` in all, multiples of 8, no larger."""
    scale = min(1.0, (pixels / (width * height)) ** 0.5)

    def side(length: int) -> int:
        cells = min(round(length * scale / SIZE_MULTIPLE), length // SIZE_MULTIPLE)
        return max(cells * SIZE_MULTIPLE, MINIMUM_SIDE)

    return side(width), side(height)


def seen_window(
    map_x: np.ndarray,  # (H, W) px, where each undistorted pixel is taken from
    map_y: np.ndarray,  # (H, W) px
    picture: Window,  # of the raw image
) -> Window:
    """Return a window of the undistorted image without pixels that no camera saw.

    Such pixels would be a black frame that stands still while the camera moves. The side with
    the largest fraction of such pixels loses one row or column until none is left.
    """
    height, width = map_x.shape
    left, top, right, bottom = *picture[:2], picture[0] + picture[2], picture[1] + picture[3]
    unseen = (map_x < left) | (map_x > right - 1) | (map_y < top) | (map_y > bottom - 1)
    left, top, right, bottom = 0, 0, width, height
    while right - left >= MINIMUM_SIDE and bottom - top >= MINIMUM_SIDE:
        inside = unseen[top:bottom, left:right]
        sides = [inside[:, 0], inside[0], inside[:, -1], inside[-1]]
        worst = int(np.argmax([side.mean() for side in sides]))
        if not sides[worst].any():
            return left, top, right - left, bottom - top
        left += worst == 0
        top += worst == 1
        right -= worst == 2
        bottom -= worst == 3
    raise InputError(
        "expected a lens distortion that leaves part of the image, found none; check k1 k2 p1 p2 k3"
    )
