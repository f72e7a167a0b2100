"""A ball that flies through a room, with the true poses and depths of the ray-caster."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import torch

from data_synth import SyntheticSequence, generate
from minislam.geometry import Camera
from minislam.records import Frame, Sequence
from minislam.stereo.dense_structure import SweepPlanner, dense_depths, swept_frames

SIZE = (160, 120)
KEYFRAMES = [0, 8, 16, 24, 31]


@cache
def clip() -> SyntheticSequence:
    return generate("ball", seed=2, frames=32, size=SIZE)


def camera() -> Camera:
    k = clip().intrinsics
    return Camera(k.fx, k.fy, k.cx, k.cy, *SIZE)


def sequence() -> Sequence:
    def frame(index: int) -> Frame:
        return Frame(index, float(clip().timestamps[index]), torch.from_numpy(clip().rgb[index]))

    return SimpleNamespace(camera=camera(), frame=frame)


def gray(index: int) -> np.ndarray:
    return cv2.cvtColor(clip().rgb[index], cv2.COLOR_RGB2GRAY)


def pose(index: int) -> np.ndarray:
    return np.linalg.inv(clip().T_world_camera[index])


@dataclass(frozen=True)
class Found:
    """What dense structure finds in a keyframe, beside the truth."""

    depth: np.ndarray
    confirmation: np.ndarray
    truth: np.ndarray
    moving: np.ndarray


@cache
def found() -> list[Found]:
    poses = {index: torch.from_numpy(pose(index)) for index in range(len(clip().rgb))}
    sparse = {k: 1 / clip().depth[k][::8, ::8].reshape(-1) for k in KEYFRAMES}
    frames = swept_frames(KEYFRAMES, list(poses))
    planner = SweepPlanner(sequence().frame, camera(), poses, sparse)
    depths = dense_depths(planner, frames, KEYFRAMES)
    return [
        Found(depth.numpy(), confirmation.numpy(), clip().depth[k], clip().masks[k])
        for k, (depth, confirmation) in zip(KEYFRAMES, depths, strict=True)
    ]
