"""Images of a finished run in motion: in a circle, or beside the input."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from minislam.data.images import write_animation
from minislam.data.run_folder import CLIP
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.runs.loaded import Run
from minislam.viz import beta_limits, beta_to_rgb

ORBIT_IMAGES, ORBIT_RATE = 90, 20.0  # images per turn; images per second
# Of the distance of the point that stays in the centre: the map holds only what the camera saw.
ORBIT_RADIUS = 0.1
LABELS = ("input", "uncertainty", "static map")
CLIP_IMAGES, CLIP_WIDTH = 60, 240  # most images of a clip; px, most of each of its three panels
_RATES = 5.0, 30.0  # images per second, least and most
_SHOWN_BETAS = 8  # frames from whose beta one range of colours is chosen


def frame_rate(run: Run) -> float:
    """Return how many of the run's frames there are per second, between 5 and 30."""
    steps = np.diff([frame.timestamp for frame in run.frames])
    return float(np.clip(1 / np.median(steps), *_RATES)) if len(steps) else _RATES[0]


def fly_around(run: Run, camera: Camera) -> Iterator[np.ndarray]:  # (H, W, 3)
    """Yield the static map from a circle around the middle keyframe, which looks at one point."""
    start = run.poses[run.keyframes[len(run.keyframes) // 2]]
    depth = run.render_depth(start)
    if not (depth > 0).any():
        raise InputError("expected a map in front of the middle keyframe, found none to fly around")
    distance = float(np.median(depth[depth > 0]))
    for angle in np.linspace(0, 2 * np.pi, ORBIT_IMAGES, endpoint=False):
        aside = ORBIT_RADIUS * np.array([np.sin(angle), np.cos(angle), 0])  # per distance
        turn = Rotation.from_rotvec([np.arctan(aside[1]), -np.arctan(aside[0]), 0])
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turn.as_matrix(), distance * aside
        yield run.render(start @ step, camera)


def side_by_side(run: Run, camera: Camera, every: int = 1) -> Iterator[np.ndarray]:  # (H, 3 W, 3)
    """Yield input, beta (in one scale) and map, as bright, of every n-th frame that has a pose."""
    shown = list(run.poses)[::every]
    sampled = shown[:: max(1, len(shown) // _SHOWN_BETAS)]
    limits = beta_limits(np.stack([run.beta(index) for index in sampled]))
    size = camera.width, camera.height
    for index in shown:
        image = run.sequence.frame(index).image.numpy()
        beta = beta_to_rgb(run.beta(index), limits)
        panels = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (image, beta)]
        color = run.render(run.poses[index], camera, run.frames[index].exposure)
        yield _labelled([*panels, color])


def clip(run: Run) -> tuple[Iterator[np.ndarray], float]:
    """Return the images of a short clip beside the input, and how many per second."""
    every = -(-len(run.poses) // CLIP_IMAGES)
    scale = min(1.0, CLIP_WIDTH / run.camera.width)
    camera = run.camera.resized(round(scale * run.camera.width), round(scale * run.camera.height))
    return side_by_side(run, camera, every), frame_rate(run) / every


def write_clip(folder: str) -> None:
    """Write the clip of a run into its folder, if this OpenCV can and TMPDIR has space."""
    with suppress(InputError, OSError):
        write_animation(Path(folder) / CLIP, *clip(Run(folder)))


def _labelled(panels: list[np.ndarray]) -> np.ndarray:
    row = np.round(255 * np.concatenate(panels, 1)).astype(np.uint8)  # OpenCV writes on bytes
    for number, label in enumerate(LABELS):
        text = label, (number * panels[0].shape[1] + 6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(row, *text, color, thickness, cv2.LINE_AA)
    return row / 255
