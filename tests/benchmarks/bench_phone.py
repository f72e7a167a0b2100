"""What a phone costs the tracker: rolling shutter, drifting light and blur, one at a time.

python -m tests.benchmarks.bench_phone [NAME:SEED ...]      default: ball:7 crowd:7

Clips of 36 frames, 15 a second, 120x160 px upright, without depth prior and without beta. The true
focal length is 136 px: first it is given, then it is sought as for a clip that notes none.
"""

import sys

import numpy as np
import torch

from data_synth import Phone, film, phone_intrinsics, scene
from minislam.config import preset
from minislam.evaluation import absolute_trajectory_error
from minislam.geometry import Camera, se3_inverse
from minislam.priors.depth import NoDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame, Trajectory
from minislam.tracking.safeguards.first_frame import has_warmed_up
from minislam.tracking.safeguards.focal_length import seek_focal_length
from minislam.tracking.tracker import Tracker

FRAMES, RATE, SIZE = 36, 15.0, (120, 160)
NOISE = 0.008  # of the sensor, in units of the full range [0, 1]
NONE = Phone(0.0, 0.0, 0.0, 0.0, band=4)
PHONES = {
    "nothing of it": {},
    "readout 20 ms": {"readout": 0.02},
    "readout 30 ms": {"readout": 0.03},
    "light and white balance drift": {"exposure": 0.25, "white": 0.08},
    "exposed 10 ms": {"shutter": 0.01},
    "exposed 30 ms": {"shutter": 0.03, "subframes": 6},
    "a phone: 20 ms, 10 ms, drift": {
        "readout": 0.02, "shutter": 0.01, "exposure": 0.25, "white": 0.08, "subframes": 2, "band": 8
    },
}  # fmt: skip


def filmed(name: str, seed: int, phone: Phone) -> list[Frame]:
    """Film a clip, with the noise of the sensor."""
    view, camera, rng = scene(name, seed), phone_intrinsics(SIZE), np.random.default_rng(seed)
    frames = []
    for index in range(FRAMES):
        image = film(view, camera, index / RATE, phone)
        image = image + NOISE * rng.standard_normal(image.shape, np.float32)
        seen = np.round(255 * image.clip(0, 1)) / 255
        frames.append(Frame(index, index / RATE, torch.from_numpy(seen.astype(np.float32))))
    return frames


def follow(frames: list[Frame], seeks_focal: bool) -> tuple[Trajectory, float]:
    """Return the keyframes' trajectory and the focal length [px] after the final adjustment."""
    settings = preset("test").tracking
    cells = torch.ones(SIZE[1] // 8, SIZE[0] // 8)
    parts = ClassicalFlow(), ClassicalFeatures(), NoDepth(), lambda index: cells
    tracker = Tracker(Camera(**vars(phone_intrinsics(SIZE))), settings, *parts)
    tracker.graph.seeks_focal = seeks_focal
    for frame in frames:
        tracker.track(frame)
        if has_warmed_up(tracker) and not tracker.initialised:
            tracker.initialise()
            tracker.refine_initialisation()
    tracker.end()
    seek_focal_length(tracker.graph)
    tracker.finish()
    stamps = np.array([frame.timestamp for frame in tracker.keyframes.frames])
    poses = se3_inverse(tracker.keyframes.T_camera_world).numpy()
    return Trajectory(stamps, poses), tracker.grid.camera.fx


def main(clips: list[str]) -> None:
    print("| clip | phone | ATE, f given [cm] | ATE, f sought [cm] | f sought [px] |")
    print("|---|---|---|---|---|")
    for clip in clips or ["ball:7", "crowd:7"]:
        name, seed = clip.split(":")
        path = scene(name, int(seed)).path
        poses = np.array([path(index / RATE) for index in range(FRAMES)])
        truth = Trajectory(np.arange(FRAMES) / RATE, poses)
        for what, effects in PHONES.items():
            frames = filmed(name, int(seed), Phone(**{**vars(NONE), **effects}))
            errors, focal = [], 0.0
            for seeks_focal in (False, True):
                estimate, focal = follow(frames, seeks_focal)
                error = absolute_trajectory_error(estimate, truth).statistics["rmse"]
                errors.append(f"{100 * error:.2f}")
            print(f"| {clip} | {what} | {' | '.join(errors)} | {focal:.1f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
