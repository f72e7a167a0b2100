"""Input options: which frames to read, at which size, with which camera. They need no torch."""

import os
import re
from dataclasses import dataclass, fields
from pathlib import Path

from minislam.errors import InputError, require
from minislam.parameters import FILES, parameter, require_bounds, user_path

SYNTHETIC = "synth:"  # before the name of a synthetic sequence
PHONE = "?phone"  # behind one that a phone films
MINIMUM_SIDE = 16  # px; smaller images hold no pair of grid cells
FOCAL_MODES = ("fixed", "refine", "auto")
FOCAL_BOUNDS = 1, 5e4  # px; refinement tries 20 times as much, and a camera has up to 1e6


@dataclass(frozen=True)
class InputOptions:
    """Which frames to read, at which size, with which camera."""

    start: int = parameter(0, "first frame of the source to use [frame]")
    stride: int = parameter(1, "use every n-th frame of the source [frame]", least=1)
    max_frames: int | None = parameter(None, "use so many frames at most, default all [frame]", 1)
    size: tuple[int, int] | None = parameter(
        None, "working size; default: keep the aspect, about `pixels` [px]", MINIMUM_SIDE, 16384
    )
    pixels: int = parameter(
        320 * 240, "about width * height of the chosen working size [px]", MINIMUM_SIDE**2
    )
    fx: float | None = parameter(None, "focal length of the raw images, x [px]", *FOCAL_BOUNDS)
    fy: float | None = parameter(None, "the same in y; default fx [px]", *FOCAL_BOUNDS)
    cx: float | None = parameter(None, "principal point of raw images, x; default centre [px]", -1)
    cy: float | None = parameter(None, "principal point of raw images, y; default centre [px]", -1)
    k1: float | None = parameter(
        None, "radial distortion of raw images; default that of the calibration [-]", -10, 10
    )
    k2: float | None = parameter(None, "the next term of the distortion, as k1 [-]", -100, 100)
    calibration: str | None = parameter(
        None, "file with fx fy cx cy [width height [k1 k2 p1 p2 k3]] of the raw images"
    )
    focal: str = parameter(
        "auto",
        "fixed: the focal length as given, noted or guessed; refine: estimated from the motion, "
        "starting there; auto: fixed if a calibration or --fx is given; else refine, and find a "
        "lens that bends straight lines",
    )
    masks: str | None = parameter(
        None,
        "files:FOLDER of PNG masks, 255 on what moves, named like the images or by number "
        "(00017.png); used instead of the learned uncertainty",
    )
    depth_scale: float = parameter(
        5000.0, "units of a depth image per metre, TUM RGB-D benchmark [1/m]", least=1e-9
    )

    def __post_init__(self) -> None:
        for field in fields(self):
            bounds = field.metadata["least"], field.metadata["most"]
            require_bounds(field.name, getattr(self, field.name), *bounds)
        wanted = f"focal as {', '.join(FOCAL_MODES)}"
        require(self.focal in FOCAL_MODES, wanted, f"{self.focal!r}; choose one")


def require_source(source: str, masks: str | None = None) -> None:
    """Refuse a sequence or masks that do not exist, before anything is loaded or rendered."""
    if masks is not None:
        mask_folder(masks)
    if source.startswith(SYNTHETIC):
        import data_synth  # only here: real footage needs no scene generator

        name, seed, _ = synthetic_parts(source)
        known = ", ".join(data_synth.SEQUENCES)
        is_known = name in data_synth.SEQUENCES and re.fullmatch(r"[0-9]{0,18}", seed) is not None
        wanted = f"synth:NAME or synth:NAME:SEED with NAME one of {known}"
        require(is_known, wanted, f"{source}; choose one of them")
        return
    path = user_path(source)
    if not (os.path.isfile(path) or os.path.isdir(path)):  # these know names of any length
        kinds = "a video file, an image folder, a TUM RGB-D folder or synth:NAME"
        found = f"{source[:300]} does not exist or is a device; check the path"
        raise InputError(f"expected {kinds}, but {found}")


def mask_folder(masks: str) -> Path:
    """Return the folder of --masks files:FOLDER; refuse what names none."""
    folder = user_path(masks.removeprefix(FILES))
    is_there, is_named = os.path.isdir(folder), masks.startswith(FILES)
    found = f"{masks}; write {FILES}{masks}" if is_there else f"no folder at {folder}; check it"
    require(is_there and is_named, f"--masks {FILES}FOLDER with a folder that exists", found)
    return folder


def synthetic_parts(source: str) -> tuple[str, str, bool]:
    """Return the name, the seed and whether a phone films, of synth:NAME[:SEED][?phone]."""
    name, _, seed = source.removeprefix(SYNTHETIC).removesuffix(PHONE).partition(":")
    return name, seed, source.endswith(PHONE)


def default_depth(source: str) -> str:
    """Return the depth prior of a source that is given without one."""
    return "simulated" if source.startswith(SYNTHETIC) else "none"
