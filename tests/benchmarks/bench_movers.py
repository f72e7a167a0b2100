"""Follow the camera through moving things, with one safeguard after the other.

    python -m tests.benchmarks.bench_movers [NAME:SEED ...]

Tracking alone, 100 frames at 320x240 with the simulated depth prior. The ATE of the keyframes in
cm, before and after the final adjustment: by least squares, with the robust weight, with the
memory of what has moved as well, and with true masks besides. About 20 s a column.
"""

import sys

import numpy as np
import torch

from minislam.config import SlamConfig
from minislam.data.sequence import open_sequence
from minislam.evaluation import absolute_trajectory_error
from minislam.geometry import se3_inverse
from minislam.priors.choice import PriorChoice
from minislam.records import Sequence, Trajectory
from minislam.runs.run import choose_priors
from minislam.tracking.config import TrackingConfig
from minislam.tracking.tracker import Tracker

SEQUENCES = (
    "static", "ball", "crowd", "umbrella", "person", "racket", "stones", "anymal1", "anymal2",
    "table1", "table2",
)  # fmt: skip
SEED = 31
COLUMNS = {  # heading: constants, true masks
    "least squares": (TrackingConfig(robust_scale=0.0, motion_memory=0.0), False),
    "+ robust": (TrackingConfig(motion_memory=0.0), False),
    "+ memory": (TrackingConfig(), False),
    "true masks": (TrackingConfig(), True),
}


def tracked(sequence: Sequence, tracking: TrackingConfig, masks: bool = False) -> Tracker:
    """Return a tracker that has followed the camera to the end, before the final adjustment."""
    priors = choose_priors(PriorChoice(depth="simulated"), sequence, SlamConfig())

    def static_weight(index: int) -> torch.Tensor:
        moving = sequence.ground_truth.moving_mask(tracker.keyframes.frames[index].frame_index)
        stride = tracker.grid.stride
        return 1.0 - float(masks) * torch.from_numpy(moving[::stride, ::stride]).float()

    tracker = Tracker(
        sequence.camera, tracking, priors.flow, priors.features, priors.depth, static_weight
    )
    for frame in sequence:
        is_start = tracker.track(frame) and not tracker.initialised
        if is_start and len(tracker.keyframes) >= tracking.warmup_keyframes:
            tracker.initialise()
            tracker.refine_initialisation()
    if not tracker.initialised:  # the clip is shorter than the warm-up
        tracker.initialise()
        tracker.refine_initialisation()
    return tracker


def keyframe_error(tracker: Tracker, sequence: Sequence) -> float:
    """Return the ATE of the keyframes [cm]."""
    stamps = np.array([frame.timestamp for frame in tracker.keyframes.frames])
    return ate(stamps, tracker.keyframes.T_camera_world, sequence)


def ate(stamps: np.ndarray, T_camera_world: torch.Tensor, sequence: Sequence) -> float:
    """Return the ATE of poses (N, 4, 4) at given times [cm]."""
    estimate = Trajectory(stamps, se3_inverse(T_camera_world).numpy())
    found = absolute_trajectory_error(estimate, sequence.ground_truth.trajectory)
    return 100 * found.statistics["rmse"]


def errors(sequence: Sequence, tracking: TrackingConfig, masks: bool) -> tuple[float, float]:
    """Return the ATE of the keyframes before and after the final adjustment [cm]."""
    tracker = tracked(sequence, tracking, masks)
    before = keyframe_error(tracker, sequence)
    tracker.finish()
    return before, keyframe_error(tracker, sequence)


def main() -> None:
    """Print one row per sequence."""
    torch.set_num_threads(1)
    print(f"{'sequence':<14}" + "".join(f"{heading:>18}" for heading in COLUMNS))
    for name in sys.argv[1:] or [f"{name}:{SEED}" for name in SEQUENCES]:
        sequence = open_sequence(f"synth:{name}")
        cells = [
            f"{before:.2f} -> {after:.2f}"
            for before, after in (errors(sequence, *column) for column in COLUMNS.values())
        ]
        print(f"{name:<14}" + "".join(f"{cell:>18}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
