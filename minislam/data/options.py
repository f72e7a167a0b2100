"""Input options: which frames to read, at which size, with which camera."""

import math
from dataclasses import dataclass, fields

from minislam.data.preparation import MINIMUM_SIDE
from minislam.errors import InputError
from minislam.parameters import parameter

FOCAL_MODES = ("fixed", "refine", "auto")


@dataclass(frozen=True)
class InputOptions:
    """Which frames to read, at which size, with which camera."""

    start: int = parameter(0, "first frame of the source to use [frame]")
    stride: int = parameter(1, "use every n-th frame of the source [frame]")
    max_frames: int | None = parameter(None, "number of frames to use at most, none: all [frame]")
    size: tuple[int, int] | None = parameter(
        None, "working width and height, none: keep the aspect and choose by `pixels` [px]"
    )
    pixels: int = parameter(320 * 240, "about width * height of the chosen working size [px]")
    fx: float | None = parameter(None, "focal length of the raw images, x [px]")
    fy: float | None = parameter(None, "focal length of the raw images, y; none: as fx [px]")
    cx: float | None = parameter(None, "principal point of the raw images, x; none: centre [px]")
    cy: float | None = parameter(None, "principal point of the raw images, y; none: centre [px]")
    calibration: str | None = parameter(
        None, "file with fx fy cx cy [width height [k1 k2 p1 p2 k3]] of the raw images"
    )
    focal: str = parameter(
        "auto",
        "fixed: the focal length as given, noted or guessed; refine: estimated from the motion, "
        "starting there; auto: refine if no calibration and no --fx is given, else fixed",
    )
    masks: str | None = parameter(
        None,
        "files:FOLDER of PNG masks, 255 on what moves, named like the images or by number "
        "(00017.png); used instead of the learnt uncertainty",
    )
    depth_scale: float = parameter(
        5000.0, "units of a depth image per metre, TUM RGB-D benchmark [1/m]"
    )

    def __post_init__(self) -> None:
        least = {"start": 0, "stride": 1, "max_frames": 1, "pixels": MINIMUM_SIDE**2}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in least and value is not None and value < least[field.name]:
                raise InputError(
                    f"expected {field.name} of at least {least[field.name]}, found {value}; "
                    "choose a larger number"
                )
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"expected a finite {field.name}, found {value}; correct it")
        if self.focal not in FOCAL_MODES:
            raise InputError(f"expected focal as {', '.join(FOCAL_MODES)}, found {self.focal!r}")
        if not self.depth_scale > 0:
            raise InputError(
                f"expected a positive depth_scale, found {self.depth_scale}; TUM files use 5000"
            )
        if self.size is not None and min(self.size) < MINIMUM_SIDE:
            raise InputError(
                f"expected a working size of at least {MINIMUM_SIDE}x{MINIMUM_SIDE} px, found "
                f"{self.size[0]}x{self.size[1]}; choose a larger one"
            )
