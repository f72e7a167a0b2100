"""Clips in which the camera sees only black for a while."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from data_synth import Intrinsics, SyntheticFrame, default_intrinsics, render_frame, scene
from data_synth.motion import FRAME_RATE
from data_synth.sequence import in_order
from minislam.geometry import Camera
from minislam.records import Frame, Trajectory

COVERED, UNCOVERED = 75, 90  # frames between which every image is black; the warm-up is over
FRAMES_AFTER = 25  # that follow the black ones


class Clip:
    """Rendered frames, numbered anew, with their truth: a `minislam.records.Sequence`."""

    def __init__(self, name: str, frames: list[SyntheticFrame], k: Intrinsics) -> None:
        self.name, self.description, self.warnings = name, f"{name}, {len(frames)} frames", []
        self.camera = Camera(k.fx, k.fy, k.cx, k.cy, k.width, k.height)
        self.refines_focal, self.focal_origin, self.seeks_lens = False, "synthetic", False
        self.ground_truth = ClipTruth(frames)
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(len(self)))

    def frame(self, frame_index: int) -> Frame:
        """Return one frame."""
        image = torch.from_numpy(self._frames[frame_index].rgb).float() / 255
        return Frame(frame_index, frame_index / FRAME_RATE, image)


class ClipTruth:
    """The truth of a clip: a `minislam.records.GroundTruth` without held-out views."""

    def __init__(self, frames: list[SyntheticFrame]) -> None:
        poses = np.array([frame.T_world_camera for frame in frames])
        self.trajectory = Trajectory(np.arange(len(frames)) / FRAME_RATE, poses)
        self._frames = frames

    def moving_mask(self, frame_index: int) -> np.ndarray:
        """Return (H, W) bool, True on dynamic objects."""
        return self._frames[frame_index].mask

    def static_image(self, frame_index: int) -> np.ndarray:
        """Return (H, W, 3) float32: the same view without dynamic objects."""
        return self._frames[frame_index].static_rgb / np.float32(255)

    def depth(self, frame_index: int) -> np.ndarray:
        """Return (H, W) float32 z-depth [m]."""
        return self._frames[frame_index].depth

    def novel_views(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return no held-out views."""
        return []


def covered_clip(name: str, seed: int, size: tuple[int, int], first_after: int) -> Clip:
    """Return a clip with black images in its middle; they are followed by frame `first_after`."""
    view, intrinsics = scene(name, seed), default_intrinsics(size)
    shown = [*range(UNCOVERED), *range(first_after, first_after + FRAMES_AFTER)]
    frames = list(in_order(lambda i: render_frame(view, intrinsics, shown[i]), len(shown)))
    for index in range(COVERED, UNCOVERED):
        frames[index] = replace(frames[index], rgb=np.zeros_like(frames[index].rgb))
    return Clip(f"covered:{name}:{seed}", frames, intrinsics)
