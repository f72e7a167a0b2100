"""What a phone costs the tracker: rolling shutter, drifting light and blur, one at a time.

python -m tests.benchmarks.bench_phone [NAME:SEED ...]      default: ball:7 crowd:7

Clips of 36 frames, 15 a second, 120x160 px upright, without depth prior and without beta. The true
focal length is 136 px. It is given, without and with an estimate of the readouts; then it is sought
as for a clip that notes none.
"""

import sys
from dataclasses import replace

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
from minislam.tracking.safeguards.rolling_shutter import Readout
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


def truth(name: str, seed: int) -> Trajectory:
    """Return the true trajectory of a clip."""
    path = scene(name, seed).path
    poses = np.array([path(index / RATE) for index in range(FRAMES)])
    return Trajectory(np.arange(FRAMES) / RATE, poses)


def follow(
    frames: list[Frame], seeks_focal: bool, rolling: bool = True
) -> tuple[Trajectory, float, Readout]:
    """Return the keyframes' trajectory, focal length [px] and readouts [s] at the end."""
    settings = replace(preset("test").tracking, rolling_shutter=rolling)
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
    tracker.finish()
    stamps = np.array([frame.timestamp for frame in tracker.keyframes.frames])
    poses = se3_inverse(tracker.keyframes.T_camera_world).numpy()
    return Trajectory(stamps, poses), tracker.grid.camera.fx, tracker.graph.shutter.readout


def main(clips: list[str]) -> None:
    print("| clip | phone | ATE, readout held [cm] | ATE [cm] | readout along x / y [ms]", end=" ")
    print("| ATE, f sought [cm] | f [px] |")
    print("|---|---|---|---|---|---|---|")
    for clip in clips or ["ball:7", "crowd:7"]:
        name, seed = clip.split(":")[0], int(clip.split(":")[1])
        for what, effects in PHONES.items():
            frames = filmed(name, seed, Phone(**{**vars(NONE), **effects}))
            held, given, sought = (
                follow(frames, seeks_focal, rolling)
                for seeks_focal, rolling in ((False, False), (False, True), (True, True))
            )
            ate = [
                absolute_trajectory_error(found[0], truth(name, seed)).statistics["rmse"]
                for found in (held, given, sought)
            ]
            errors = [f"{100 * error:.2f}" for error in ate]
            readout = " / ".join(f"{1000 * seconds:.1f}" for seconds in given[2])
            row = [clip, what, *errors[:2], readout, errors[2], f"{sought[1]:.1f}"]
            print("|", " | ".join(row), "|", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
