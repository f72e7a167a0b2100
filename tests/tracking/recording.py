"""A small synthetic recording, and a tracker that runs through it."""

from collections.abc import Sequence
from functools import cache

import torch

from data_synth import SyntheticSequence, generate
from minislam.geometry import Camera, se3_inverse
from minislam.priors.depth import NoDepth, SensorDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.records import Frame, Trajectory
from minislam.tracking.config import TrackingConfig
from minislam.tracking.safeguards.first_frame import FirstFrame
from minislam.tracking.tracker import Tracker

SIZE = (160, 120)
FRAMES = 30
# Five keyframes in thirty frames; the flow is that of a 320x240 image.
CONFIG = TrackingConfig(warmup_keyframes=3, keyframe_flow=8.0, keyframe_flow_without_prior=8.0)
WHERE_LOST = 17  # a frame after the warm-up


@cache
def recording() -> SyntheticSequence:
    return generate("static", seed=1, frames=FRAMES, size=SIZE)


def frames() -> list[Frame]:
    rgb, times = recording().rgb, recording().timestamps
    return [Frame(i, float(times[i]), torch.from_numpy(rgb[i])) for i in range(FRAMES)]


def new_tracker(with_depth: bool, shown: Sequence[int] = range(FRAMES)) -> Tracker:
    """Return a tracker for a sequence whose frame k shows what the recording shows in shown[k]."""
    k = recording().intrinsics
    camera = Camera(k.fx, k.fy, k.cx, k.cy, *SIZE)
    depth = SensorDepth(lambda index: recording().depth[shown[index]]) if with_depth else NoDepth()

    def everything_is_static(keyframe_index: int) -> torch.Tensor:
        return torch.ones(15, 20)

    return Tracker(
        camera, CONFIG, ClassicalFlow(), ClassicalFeatures(), depth, everything_is_static
    )


def run(tracker: Tracker, images: list[Frame]) -> None:
    first_frame = FirstFrame()
    while (index := first_frame.next_frame(tracker, len(images))) is not None:
        tracker.track(images[index])
        if not tracker.initialised and len(tracker.keyframes) == CONFIG.warmup_keyframes:
            tracker.initialise()
            tracker.refine_initialisation()
    if not tracker.initialised:
        tracker.initialise()
    tracker.finish()


def lost_frames(tracker: Tracker) -> list[int]:
    return [frame.frame_index for frame in tracker.tracked if not frame.status.is_followed]


def trajectories(tracker: Tracker) -> tuple[Trajectory, Trajectory]:
    """Return the estimated and the true trajectory of the keyframes."""
    chosen = [frame.frame_index for frame in tracker.keyframes.frames]
    times = recording().timestamps[chosen]
    estimate = se3_inverse(tracker.keyframes.T_camera_world).numpy()
    return Trajectory(times, estimate), Trajectory(times, recording().T_world_camera[chosen])
