"""Break a run in many ways: is each break declared, or survived? And does a good run stay quiet?

    python -m tests.benchmarks.bench_broken broken NAME:SEED OTHER:SEED [none] [CLIP ...]
    python -m tests.benchmarks.bench_broken good [none] NAME:SEED ...
    python -m tests.benchmarks.bench_broken pieces FOLDER LENGTH [none]

Tracking alone, at 160x120; `pieces` takes a real sequence in pieces of LENGTH frames at its usual
size. With the simulated depth prior, or with `none`. A row tells the ATE of all posed frames and
the spread of the true camera centres [cm], of all keyframes the least explained flow, the largest
depth error, the least continuity and the least agreement, and what the run says: lost frames,
breaks, a doubtful focal length. A run is survived if its ATE is below SURVIVED of that spread.
"""

import sys
import time
from dataclasses import replace

import numpy as np
import torch

from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from minislam.evaluation import absolute_trajectory_error
from minislam.geometry import se3_inverse
from minislam.priors.depth import NoDepth, SimulatedDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame, Sequence, Trajectory
from minislam.stereo.second_adjustment import adjust_again
from minislam.tracking.config import TrackingConfig
from minislam.tracking.safeguards.first_frame import has_warmed_up
from minislam.tracking.safeguards.focal_length import check_focal_length
from minislam.tracking.tracker import Tracker
from minislam.tracking.trajectory import pose_all_frames
from tests.benchmarks.broken_clips import base, clip, clips

SURVIVED = 0.05  # of the spread of the camera centres


class Piece:
    """Some frames of a sequence, numbered anew."""

    def __init__(self, whole: Sequence, first: int, count: int) -> None:
        self.camera, self.ground_truth = whole.camera, whole.ground_truth
        self.name = f"{whole.name} {first}"
        self._whole, self._first, self._count = whole, first, count

    def __len__(self) -> int:
        return self._count

    def __iter__(self):
        return (self.frame(index) for index in range(self._count))

    def frame(self, frame_index: int) -> Frame:
        """Return one frame."""
        return replace(self._whole.frame(self._first + frame_index), frame_index=frame_index)

    def depth(self, frame_index: int) -> np.ndarray | None:
        """Return the sensor's depth (H, W)."""
        return self._whole.sensor_depth(self._first + frame_index)


def followed(sequence: Sequence, with_prior: bool) -> Tracker:
    """Return a tracker that has followed the sequence, final adjustments included."""
    depth = sequence.depth if isinstance(sequence, Piece) else sequence.ground_truth.depth
    prior = SimulatedDepth(depth, 0) if with_prior else NoDepth()
    config = TrackingConfig()
    flow, features = ClassicalFlow(), ClassicalFeatures()
    tracker = Tracker(
        sequence.camera, config, flow, features, prior, lambda _: torch.ones(tracker.grid.shape)
    )
    for frame in sequence:
        tracker.track(frame)
        if not tracker.initialised and has_warmed_up(tracker):
            tracker.initialise()
            tracker.refine_initialisation()
    if not tracker.initialised:
        tracker.initialise()
        tracker.refine_initialisation()
    tracker.end()
    tracker.finish()
    if tracker.knows_depth:
        adjust_again(tracker, sequence)
    return tracker


def row(name: str, sequence: Sequence, with_prior: bool, holds: bool = True) -> str:
    """Run a clip; return a line of the table. `holds`: the truth holds across the break."""
    begun = time.perf_counter()
    tracker = followed(sequence, with_prior)
    focal = check_focal_length(tracker.graph)
    poses = pose_all_frames(tracker, sequence)
    stamps = {tracked.frame_index: tracked.timestamp for tracked in tracker.tracked}
    estimate = Trajectory(
        np.array([stamps[index] for index in poses]),
        se3_inverse(torch.stack(list(poses.values()))).numpy(),
    )
    try:
        error = absolute_trajectory_error(
            estimate, sequence.ground_truth.trajectory, max_difference=0.02
        )
        centres = error.truth.T_world_camera[:, :3, 3]
        spread = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
        ate = error.statistics["rmse"]
    except (InputError, AttributeError):
        ate, spread = np.nan, np.nan
    lost = [t.frame_index for t in tracker.tracked if not t.status.is_followed]
    breaks = [(found.first_frame, found.last_frame) for found in tracker.watch.breaks]
    said = [f"broken {', '.join(f'{first}..{last}' for first, last in breaks)}"] if breaks else []
    said += [f"focal x {focal.factor:.2f} saves {focal.saved:.0%}"] if focal.is_doubtful else []
    survived = holds and ate < SURVIVED * spread
    is_alarmed = bool(said)
    said += [f"lost {lost[0]}..{lost[-1]} ({len(lost)})"] if lost else []
    verdict = "declared" if said else "MISSED"
    if survived:
        verdict = "ALARM" if is_alarmed else "fine"
    found = tracker.watch.diagnostics
    explained = min(d.explained for d in found if d.explained is not None)
    error = max(d.depth_error for d in found if d.depth_error is not None)
    continuity = min((d.continuity for d in found if d.continuity is not None), default=np.nan)
    agreement = min((d.agreement for d in found if d.agreement is not None), default=np.nan)
    return (
        f"{name:24s} {verdict:9s} {100 * ate:7.2f} {100 * spread:6.1f}  {explained:.2f} "
        f"{error:.3f} {continuity:.3f} {agreement:.2f}  {len(tracker.keyframes):3d} kf "
        f"{time.perf_counter() - begun:4.0f} s  {'; '.join(said)}"
    )


def _scene(text: str) -> tuple[str, int]:
    name, _, seed = text.partition(":")
    return name, int(seed)


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    mode, *arguments = sys.argv[1:]
    with_prior = "none" not in arguments
    arguments = [argument for argument in arguments if argument != "none"]
    if mode == "broken":
        (name, seed), other = _scene(arguments[0]), _scene(arguments[1])
        made = clips(name, seed, base(name, seed), base(*other))
        for label in arguments[2:] or made:
            frames, holds, factor = made[label]
            print(row(label, clip(label, frames, factor=factor), with_prior, holds), flush=True)
    elif mode == "good":
        for text in arguments:
            print(row(text, clip(text, base(*_scene(text))), with_prior), flush=True)
    else:
        whole, length = open_sequence(arguments[0]), int(arguments[1])
        for first in range(0, len(whole) - length + 1, length):
            piece = Piece(whole, first, length)
            print(row(piece.name, piece, with_prior), flush=True)


if __name__ == "__main__":
    main()
