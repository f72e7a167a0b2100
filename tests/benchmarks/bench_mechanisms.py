"""Measure one mechanism: every row is a sequence with the mechanism on or off.

    python -m tests.benchmarks.bench_mechanisms MECHANISM [NAME:SEED ...]

The depth prior is simulated. `relocalisation` tracks alone, about 20 s a row.
`pose_refinement` (of the frames between the keyframes), `fine_beta` (a finer grid) and
`densification` do whole runs, about 100 s each; `--frames 60 --set mapping.refine_iterations=300`
halves that. Differences below 0.01 cm in ATE and 0.1 dB in PSNR are noise.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from unittest import mock

import numpy as np
import torch

from data_synth.cli import parse_size
from minislam.config import PRESETS, SlamConfig, preset, with_settings
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.evaluation.metrics import MappedView, measure_run
from minislam.geometry import se3_inverse
from minislam.priors.choice import PriorChoice
from minislam.records import Sequence, Trajectory
from minislam.runs.measures import mapped_views
from minislam.runs.run import choose_priors
from minislam.slam import Slam
from minislam.tracking.config import TrackingConfig
from minislam.tracking.safeguards.relocalisation import Relocaliser
from minislam.tracking.trajectory import pose_all_frames
from tests.benchmarks.bench_movers import ate, tracked
from tests.benchmarks.incidents import COVERED, covered_clip

SEQUENCES = ("ball:71", "crowd:71", "table2:71")
Rows = Iterator[tuple[str, dict[str, float]]]  # heading of the row, and its figures by name
FAR_BACK = 10  # frame shown after the black ones when the camera is at an earlier place
MANY_GAUSSIANS = 200_000  # a limit that densification does not reach here


@dataclass(frozen=True)
class Source:
    """A synthetic sequence: its name and seed, how many frames of it, and their size."""

    name: str
    seed: int
    frames: int
    size: tuple[int, int]  # width, height [px]

    def sequence(self) -> Sequence:
        """Return its first frames."""
        options = InputOptions(max_frames=self.frames, size=self.size)
        return open_sequence(f"synth:{self.name}:{self.seed}", options)


def relocalisation(clip: Source, config: SlamConfig) -> Rows:
    """Cover the camera for 15 frames; then it is where it was, or at an earlier place."""
    clips = {"same place": COVERED, "earlier place": FAR_BACK}
    for heading, first_after in clips.items():
        sequence = covered_clip(clip.name, clip.seed, clip.size, first_after)
        yield f"{heading}, on", followed_frames(sequence, config.tracking)
        with mock.patch.object(Relocaliser, "find", lambda self, image, features: None):
            yield f"{heading}, off", followed_frames(sequence, config.tracking)


def followed_frames(sequence: Sequence, config: TrackingConfig) -> dict[str, float]:
    """Return how many frames of a clip have a pose, and the error of all of these."""
    tracker = tracked(sequence, config)
    tracker.finish()
    poses = pose_all_frames(tracker, sequence)
    stamps = np.array([sequence.frame(index).timestamp for index in poses])
    error = ate(stamps, torch.stack(list(poses.values())), sequence)
    return {"frames with a pose": len(poses), "ATE [cm]": error}


def pose_refinement(clip: Source, config: SlamConfig) -> Rows:
    """Leave the poses between the keyframes of one run as they are, and refine them."""
    slam = finished(clip, config)
    start = slam.trajectory()
    for heading, trajectory in {"off": start, "on": refined(slam, start)}.items():
        found = measured(slam, trajectory, views=[])
        yield heading, chosen(found, "ate_all_cm", "psnr_novel_db", "psnr_novel_oriented_db")


def refined(slam: Slam, start: Trajectory) -> Trajectory:
    """Return a trajectory whose poses between the keyframes are refined by re-rendering."""
    features = choose_priors(SIMULATED, slam.sequence, slam.config).features
    numbers = {tracked.timestamp: tracked.frame_index for tracked in slam.tracker.tracked}
    keyframes = {frame.frame_index for frame in slam.tracker.keyframes.frames}
    poses = torch.from_numpy(start.T_world_camera).clone()
    for row, timestamp in enumerate(start.timestamps):
        if numbers[timestamp] in keyframes:
            continue
        frame = slam.sequence.frame(numbers[timestamp])
        beta = slam.mapper.predict_beta(features(frame))
        (pose,) = slam.mapper.refine_poses([se3_inverse(poses[row])], [frame.image], [beta])
        poses[row] = se3_inverse(pose)
    return Trajectory(start.timestamps, poses.numpy())


def fine_beta(clip: Source, config: SlamConfig) -> Rows:
    """Learn the uncertainty on the grid of the features, and on one twice as fine."""
    names = "beta_auroc", "psnr_masked_db", "psnr_novel_oriented_db", "ate_all_cm"
    for factor in (1, 2):
        changed = with_settings(config, {"uncertainty.grid_factor": factor})
        slam = finished(clip, changed)
        yield f"grid factor {factor}", chosen(measured(slam, slam.trajectory()), *names)


def densification(clip: Source, config: SlamConfig) -> Rows:
    """Map without and with cloning and splitting."""
    names = "psnr_novel_oriented_db", "psnr_input_db", "psnr_masked_db", "ate_all_cm"
    for heading, most in {"off": 0, "on": MANY_GAUSSIANS}.items():
        changed = with_settings(config, {"mapping.density.max_gaussians": most})
        slam = finished(clip, changed)
        count = {"Gaussians": len(slam.mapper.gaussians)}
        yield heading, count | chosen(measured(slam, slam.trajectory()), *names)


MECHANISMS = {
    "relocalisation": relocalisation,
    "pose_refinement": pose_refinement,
    "fine_beta": fine_beta,
    "densification": densification,
}
SIMULATED = PriorChoice(depth="simulated")


@cache
def finished(clip: Source, config: SlamConfig) -> Slam:
    """Return the system after a whole run."""
    sequence = clip.sequence()
    slam = Slam(sequence, config, choose_priors(SIMULATED, sequence, config))
    slam.run()
    return slam


def measured(
    slam: Slam, trajectory: Trajectory, views: list[MappedView] | None = None
) -> dict[str, float | None]:
    """Return the metrics of a run by name, with the keyframes as views if none are given."""
    truth, keyframes = slam.sequence.ground_truth, slam.keyframe_trajectory()
    seen = mapped_views(slam) if views is None else views
    return measure_run(truth, trajectory, keyframes, seen, slam.render)


def chosen(metrics: dict[str, float | None], *names: str) -> dict[str, float]:
    """Return some of the metrics, without those that are unknown."""
    return {name: metrics[name] for name in names if metrics[name] is not None}


def main() -> None:
    """Print the rows of one mechanism."""
    parser = argparse.ArgumentParser()
    parser.add_argument("mechanism", choices=MECHANISMS)
    parser.add_argument("names", nargs="*", metavar="NAME:SEED", default=SEQUENCES)
    parser.add_argument("--preset", choices=PRESETS, default="laptop")
    parser.add_argument("--frames", type=int, default=100, help="of each sequence")
    parser.add_argument("--size", default="320x240", help="width x height [px]")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = dict(setting.split("=") for setting in given.set)
    config = with_settings(preset(given.preset), settings)
    size = parse_size(given.size)
    for sequence in given.names:
        name, seed = sequence.split(":")
        clip = Source(name, int(seed), given.frames, size)
        for heading, figures in MECHANISMS[given.mechanism](clip, config):
            cells = ", ".join(f"{figure} {round(value, 3)}" for figure, value in figures.items())
            print(f"{sequence:<12}{heading:<26}{cells}", flush=True)


if __name__ == "__main__":
    main()
