"""Camera intrinsics: read from a file, known from a benchmark, or guessed with a warning."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from minislam.data.files import data_rows, finite_numbers, read_text
from minislam.data.options import FOCAL_BOUNDS
from minislam.errors import InputError, require
from minislam.geometry import BrownDistortion, Camera
from minislam.parameters import require_bounds

# Focal length over the longer image side when nothing is known: phone and consumer cameras film
# with 0.75 to 0.95 (a 26-30 mm equivalent lens, a little cropped by stabilisation).
_GUESSED_FOCAL_RATIO = 0.85

# Two aspect ratios closer than this belong to the same image, resized and rounded to pixels.
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of the raw images, as found: the image size may be unknown."""

    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    size: tuple[int, int] | None = None  # (width, height) px of the images it was made for
    distortion: BrownDistortion = field(default_factory=BrownDistortion)
    origin: str = "calibration"  # where it comes from, for messages
    is_rough: bool = False  # its focal length is only a first guess

    def camera_for(self, width: int, height: int) -> Camera:
        """Return the camera of raw images of `width` x `height`."""
        made_for = self.size or (width, height)
        wanted = "images of {}x{} px or a resized version of that".format(*made_for)
        found = f"{width}x{height}; calibration and images do not match"
        require(self.fits(width, height), f"{wanted} ({self.origin})", found)
        try:
            return Camera(self.fx, self.fy, self.cx, self.cy, *made_for).resized(width, height)
        except InputError as error:
            raise InputError(f"{self.origin}: {error}") from error

    def fits(self, width: int, height: int) -> bool:
        """Tell whether images of this size have the aspect that the calibration was made for."""
        if self.size is None:
            return True
        return abs(self.size[0] * height / (self.size[1] * width) - 1) <= _ASPECT_TOLERANCE


def calibration_beside(folder: Path, name: str = "calibration.txt") -> Calibration | None:
    """Return the calibration that lies beside the images, if there is one."""
    return read_calibration(folder / name) if (folder / name).is_file() else None


def rough_calibration(
    picture: tuple[int, int, int, int],  # left, top, width, height [px] between black bars
    noted: tuple[float, str] | None = None,  # focal length over the diagonal, and its origin
) -> Calibration:
    """Return rough intrinsics of images: guessed, unless the camera noted its own."""
    left, top, width, height = picture
    focal, origin = _GUESSED_FOCAL_RATIO * max(width, height), "guessed intrinsics"
    if noted:
        focal, origin = noted[0] * math.hypot(width, height), noted[1]
    centre = left + (width - 1) / 2, top + (height - 1) / 2
    return Calibration(focal, focal, *centre, origin=origin, is_rough=True)


def read_calibration(path: Path) -> Calibration:
    """Read `fx fy cx cy [width height [k1 k2 p1 p2 k3]]` from a text file."""
    fields = " ".join(row for _, row in data_rows(read_text(path), "")).replace(",", " ").split()
    wanted = "4, 6 or 11 numbers, fx fy cx cy [width height [k1 k2 p1 p2 k3]]"
    found = f"{len(fields)} in {path}; add or remove numbers"
    require(len(fields) in (4, 6, 11), wanted, found)
    fx, fy, cx, cy, *optional = finite_numbers(fields, str(path))
    require_bounds(f"fx and fy, in pixels, in {path}", (fx, fy), *FOCAL_BOUNDS)
    size = (int(optional[0]), int(optional[1])) if optional else None
    is_whole = size is None or (size == tuple(optional[:2]) and min(size) >= 1)
    found = f"{' and '.join(fields[4:6])} in {path}; correct them"
    require(is_whole, "width and height as positive whole numbers", found)
    return Calibration(fx, fy, cx, cy, size, BrownDistortion(*optional[2:]), path.name)
