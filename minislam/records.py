"""The data that one stage gives to another (frozen), and the protocols of the input."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.geometry import Camera

Progress = Callable[[int, int], None]  # called with the steps done and their number
FramePicture = Callable[[int], np.ndarray | None]  # of a frame, by its index; None: unknown


class Pictured:
    """Anything that has an image. It is kept as bytes: floats take four times the memory."""

    pixels: Tensor  # (H, W, 3) uint8 RGB; an image in [0, 1] is taken as it is
    exposure: Tensor | None = None  # (3,) brightness over that of the map; None: 1

    @property
    def image(self) -> Tensor:
        """Return the image (H, W, 3) float32 RGB in [0, 1]."""
        return self.pixels if self.pixels.is_floating_point() else self.pixels / 255

    @property
    def levelled(self) -> Tensor:
        """Return the image (H, W, 3) as bright as the map."""
        return self.image if self.exposure is None else self.image / self.exposure

    def exposed(self, color: Tensor) -> Tensor:
        """Return colours (..., 3) of the map as bright as the image, in [0, 1]."""
        return (color if self.exposure is None else color * self.exposure).clamp(0, 1)


@dataclass(frozen=True)
class Frame(Pictured):
    """One input image."""

    frame_index: int  # position in the sequence as it is processed: 0, 1, 2, ...
    timestamp: float  # second, as the source gives it
    pixels: Tensor  # (H, W, 3) uint8 RGB, undistorted, at the working size
    exposure: Tensor | None = None  # (3,) see `Pictured`
    step: float = math.inf  # s between two images of the source: no shutter takes longer

    def to(self, device: torch.device | str) -> "Frame":
        """Return the frame with its image on a device."""
        return replace(self, pixels=self.pixels.to(device))


@dataclass(frozen=True)
class MapImage(Pictured):
    """An image that the map is fitted to: a keyframe, or at the end a frame between two."""

    frame_index: int  # position among the frames
    pixels: Tensor  # (H, W, 3) uint8 RGB
    features: Tensor  # (h', w', C) float32, one vector per patch of the feature grid
    depth: Tensor  # (H, W) float32 world units, 0 where unknown: the mapper's reference D~
    T_camera_world: Tensor  # (4, 4) float64
    moving_mask: Tensor | None = None  # (H, W) bool, True on dynamic objects, if given (ablation)
    # (h', w') near 1 where several views agree, below 0 where those of other times look through
    confirmation: Tensor | None = None
    exposure: Tensor | None = None  # (3,) see `Pictured`
    inserts: bool = True  # whether it adds Gaussians; else it only enters the losses
    filled: Tensor | None = None  # (H, W) bool, True where depth is not measured, but filled in


@dataclass(frozen=True)
class Trajectory:
    """Stamped camera poses, in the order of their timestamps."""

    timestamps: np.ndarray  # (N,) float64 second, strictly increasing
    T_world_camera: np.ndarray  # (N, 4, 4) float64

    @property
    def centres(self) -> np.ndarray:
        """Return the camera centres (N, 3) in the world."""
        return self.T_world_camera[:, :3, 3]

    def __len__(self) -> int:
        return len(self.timestamps)


class TrackingStatus(Enum):
    """What the tracker knows about one frame."""

    INITIALISING = "initialising"  # followed, but there is no map yet
    OK = "ok"
    LOST = "lost"  # without a pose
    GIVEN_UP = "start given up"  # followed from a start that another replaced, without a pose

    @property
    def is_followed(self) -> bool:
        """Tell whether the frame gets a pose."""
        return self in (TrackingStatus.INITIALISING, TrackingStatus.OK)


@dataclass(frozen=True)
class TrackedFrame:
    """Tracking result of one frame."""

    frame_index: int
    timestamp: float  # second
    status: TrackingStatus
    matched_ratio: float  # of the last keyframe, [-]

    @property
    def reason(self) -> str:
        """Return why the frame has no pose."""
        ratio = f", matched ratio {self.matched_ratio:.3f}"
        return self.status.value + (ratio if self.status is TrackingStatus.LOST else "")


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth of a benchmark, which the system must not see. Each part may be None."""

    trajectory: Trajectory | None  # in the benchmark's own world and at its own timestamps
    moving_mask: FramePicture  # (H, W) bool, True where a dynamic object is seen
    static_image: FramePicture  # (H, W, 3) float32, without dynamic objects and shadows
    depth: FramePicture  # (H, W) float32 z-depth of what the camera saw, 0 where unknown
    novel_views: Callable[[], list[tuple[np.ndarray, np.ndarray]]]
    # held-out static views: T_world_camera (4, 4) and image (H, W, 3); may be []


class Sequence(Protocol):
    """A sequence whose frames can be read as often as needed, in any order."""

    name: str  # short, usable as a folder name
    description: str  # one line: what was found
    camera: Camera  # of the undistorted images at the working size
    refines_focal: bool  # whether the focal length is to be estimated, the camera's is a guess
    focal_origin: str  # what tells the camera's focal length; empty for a mere guess
    seeks_lens: bool  # whether a lens that bends straight lines is to be found, too
    warnings: list[str]  # what the user must know, for instance that the focal length is guessed
    unread: list[tuple[float, str]]  # timestamp [s] and reason of images that are left out
    checksums: dict[int, int]  # of the images read so far, by frame index
    ground_truth: GroundTruth | None
    read_depth: Callable[[Path], np.ndarray]  # a depth image, as (H, W) [m], 0 where unknown
    files: list[Path]  # that hold the images and masks
    opened_as: dict[str, Any]  # "sequence" and "input", the part of config.json that opens it
    preparation: dict[str, Any]  # how raw images became working images, see `ImagePreparation`

    def __len__(self) -> int:
        """Return the number of frames."""

    def frame(self, frame_index: int) -> Frame:
        """Return one frame again."""

    def through_lens(self, fx: float, k1: float, k2: float) -> "Sequence":
        """Return the sequence, straightened; fx [px] of the working images is a first guess."""

    def source_name(self, frame_index: int) -> str:
        """Return the name of a frame's image file, or of its video with the number in it."""

    def source_index(self, frame_index: int) -> int:
        """Return the number of a frame among all images of the source."""

    def given_mask(self, frame_index: int) -> np.ndarray | None:
        """Return (H, W) bool, True where something moves; None if no masks are given."""

    def sensor_depth(self, frame_index: int) -> np.ndarray | None:
        """Return the depth sensor's z-depth (H, W) [m], 0 where unknown; None without a sensor."""


def required_mask(sequence: Sequence, frame_index: int) -> np.ndarray:  # (H, W) bool
    """Return the mask of dynamic objects that a frame must have, where masks are used."""
    mask = sequence.given_mask(frame_index)
    if mask is None:
        wanted = f"a mask of movers for every frame of {sequence.name}"
        advice = "give --masks files:FOLDER, or set uncertainty.given_masks to off"
        raise InputError(f"expected {wanted}, found none for {frame_index}; {advice}")
    return mask
