"""An oracle in the place of DROID's network: it knows the truth, and errs as the network does.

Everything around the network is that of `DroidFlow`: edges, hidden states, chains, units. An answer
goes a limited way towards the true flow of the static scene, with noise, and its confidence is
given; it is nearly zero on dynamic objects and where the target does not show the same point.
"""

import zlib
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from data_synth import default_intrinsics, generate, scene
from data_synth.motion import FRAME_RATE
from data_synth.render import NOTHING, camera_rays, trace
from minislam.evaluation.trajectory import absolute_trajectory_error
from minislam.geometry import Camera, se3_inverse
from minislam.priors.depth import NoDepth, SimulatedDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.interfaces import FlowEstimator
from minislam.priors.networks.droid import DroidFlow, DroidFlowConfig, EncodedFrame
from minislam.priors.networks.droid_network import STRIDE
from minislam.records import Frame, Trajectory
from minislam.tracking.config import TrackingConfig
from minislam.tracking.tracker import Tracker
from minislam.tracking.trajectory import pose_all_frames

UNSEEN = 0.002  # confidence of a cell that moves or is occluded [-]
SAME_DEPTH = 0.05  # relative difference of depths that show the same point [-]


@dataclass(frozen=True)
class Skill:
    """What an oracle can do."""

    gain: float = 0.75  # part of the error that one update removes [-]
    cap: float = 4.0  # cells, longest step of one update
    confidence: float = 0.9  # of cells that are seen [-]
    confident: float = 1.0  # part of these that has this confidence; the others have .03 [-]
    noise: float = 0.3  # px per update


SKILLS = {
    "good network": Skill(),
    "noise of half a pixel": Skill(noise=0.5),
    "one cell per update": Skill(gain=0.4, cap=1.0),
    "confidence .3": Skill(confidence=0.3),
    "15 % confident": Skill(confidence=0.8, confident=0.15),
    "8 % confident": Skill(confidence=0.8, confident=0.08),
    "confidence .08": Skill(confidence=0.08),
}


@dataclass(frozen=True)
class Clip:
    """A clip with its truth, of which the tracker sees the images."""

    camera: Camera
    timestamps: np.ndarray  # (F,) s
    T_world_camera: np.ndarray  # (F, 4, 4)
    depth: np.ndarray  # (F, H, W) m
    masks: np.ndarray  # (F, H, W) bool, dynamic objects
    rgb: np.ndarray  # (F, H, W, 3) float32; all differ, so that the oracle knows them again

    def frame(self, index: int) -> Frame:
        """Return a frame."""
        return Frame(index, float(self.timestamps[index]), torch.from_numpy(self.rgb[index]))


def plain_clip(name: str, seed: int, frames: int, size: tuple[int, int] = (320, 240)) -> Clip:
    """Return a clip whose images are plain, since an oracle needs no picture: quickly made."""
    view, k = scene(name, seed), default_intrinsics(size)
    camera = Camera(k.fx, k.fy, k.cx, k.cy, *size)
    times = np.arange(frames) / FRAME_RATE
    poses = np.array([view.path(time) for time in times])
    depth = np.empty((frames, size[1], size[0]), np.float32)
    masks = np.empty(depth.shape, bool)
    for index, time in enumerate(times):
        rays = camera_rays(k, poses[index])
        behind, _ = trace(view.room.parts, rays)
        moving = [part for parts in view.mover_parts(time) for part in parts]
        depth[index], seen = trace(moving, rays, behind)
        masks[index] = seen != NOTHING
    shades = np.linspace(0.1, 0.9, frames, dtype=np.float32)
    rgb = np.broadcast_to(shades[:, None, None, None], (*depth.shape, 3)).copy()
    return Clip(camera, times, poses, depth, masks, rgb)


def rendered_clip(name: str, seed: int, frames: int, size: tuple[int, int] = (320, 240)) -> Clip:
    """Return a clip with its pictures, which the classical flow needs."""
    c = generate(name, seed, frames, size)
    k = c.intrinsics
    camera = Camera(k.fx, k.fy, k.cx, k.cy, *size)
    return Clip(camera, c.timestamps, c.T_world_camera, c.depth, c.masks, c.rgb)


class OracleFlow(DroidFlow):
    """A `DroidFlow` whose network is an oracle; a frame is recognised by its image."""

    def __init__(self, clip: Clip, skill: Skill, config: DroidFlowConfig) -> None:
        super().__init__(_NoWeights(), config)
        self.update, self.damping = self.answers, lambda hidden: torch.full(hidden.shape[2:], 0.007)
        self.clip, self.skill = clip, skill
        self._index = {_key(torch.from_numpy(rgb)): k for k, rgb in enumerate(clip.rgb)}
        self._truth: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def encode(self, image: Tensor) -> EncodedFrame:
        """Return the number of a frame in the place of its features; -1 for an unknown image."""
        return _Numbered(image, self._index.get(_key(image), -1))

    def answers(
        self,
        source: Tensor,
        target: Tensor,
        hidden: Tensor,
        context: Tensor,
        expected: Tensor,  # (E, h, w, 2) cells
        last_target: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Answer as the network does."""
        numbers = [x[:, 0, 0, 0].int().tolist() for x in (source, target, hidden)]
        answers = [self.answer(*n, e) for *n, e in zip(*numbers, expected, strict=True)]
        targets, confidences = (torch.stack(part) for part in zip(*answers, strict=True))
        return hidden + 1, targets, confidences[..., None].expand(-1, -1, -1, 2)

    def answer(
        self, source: int, target: int, updates: int, expected: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the target (h, w, 2) [cells] of one update and its confidence (h, w)."""
        skill, shape = self.skill, expected.shape[:2]
        rng = np.random.default_rng([source + 1, target + 1, updates])
        noise = torch.from_numpy(rng.normal(0, skill.noise / STRIDE, (*shape, 2))).float()
        if source < 0 or target < 0:  # not the same scene: anything, without confidence
            return expected + 20 * noise, torch.full(shape, UNSEEN)
        true, seen = self._true_flow(source, target)
        step = (skill.gain * (true - expected)).clamp(-skill.cap, skill.cap)
        rng = np.random.default_rng(source)
        chosen = torch.from_numpy(rng.random(shape) < skill.confident)
        confidence = torch.where(chosen, skill.confidence, 0.03)
        return expected + step + noise, torch.where(seen, confidence, UNSEEN)

    def _true_flow(self, source: int, target: int) -> tuple[Tensor, Tensor]:
        """Return the true targets (h, w, 2) [cells] and which cells (h, w) show the same point."""
        if (source, target) not in self._truth:
            clip, camera = self.clip, self.clip.camera
            world = torch.from_numpy(clip.T_world_camera)
            motion = se3_inverse(world[target]) @ world[source]
            grid = camera.pixel_grid(STRIDE).double()
            depth = torch.from_numpy(clip.depth[source][::STRIDE, ::STRIDE]).double()
            points = camera.rays(grid.reshape(-1, 2)) * depth.reshape(-1, 1)
            points = points @ motion[:3, :3].T + motion[:3, 3]
            where = camera.project(points)
            nearest = where.round().long()
            inside = camera.contains(where) & (points[:, 2] > 0.1)
            u, v = (nearest[:, a].clamp(0, n - 1) for a, n in enumerate(clip.depth.shape[:0:-1]))
            there = torch.from_numpy(clip.depth[target])[v, u]
            moves = torch.from_numpy(clip.masks[target])[v, u]
            moves |= torch.from_numpy(clip.masks[source][::STRIDE, ::STRIDE]).reshape(-1)
            same = (there / points[:, 2] - 1).abs() < SAME_DEPTH
            shape = depth.shape
            targets = (where / STRIDE).float().reshape(*shape, 2)
            self._truth[source, target] = targets, (inside & same & ~moves).reshape(shape)
        return self._truth[source, target]


def new_tracker(
    clip: Clip, flow: FlowEstimator, config: TrackingConfig, with_depth: bool = True
) -> Tracker:
    """Return a tracker for which everything is static, as without beta."""
    depth = SimulatedDepth(lambda index: clip.depth[index], seed=0) if with_depth else NoDepth()
    tracker = Tracker(clip.camera, config, flow, ClassicalFeatures(), depth, lambda index: ones)
    ones = torch.ones(tracker.grid.shape)
    return tracker


def follow(tracker: Tracker, clip: Clip, frames: range) -> None:
    """Show frames to a tracker."""
    for index in frames:
        tracker.track(clip.frame(index))
        if not tracker.initialised:
            if len(tracker.keyframes) >= tracker.config.warmup_keyframes:
                tracker.initialise()
                tracker.refine_initialisation()


def track(
    clip: Clip, flow: FlowEstimator, config: TrackingConfig, with_depth: bool = True
) -> Tracker:
    """Return a tracker after the whole clip."""
    tracker = new_tracker(clip, flow, config, with_depth)
    follow(tracker, clip, range(len(clip.timestamps)))
    if not tracker.initialised:
        tracker.initialise()
        tracker.refine_initialisation()
    tracker.end()
    tracker.finish()
    return tracker


def errors(clip: Clip, tracker: Tracker) -> tuple[float, float]:
    """Return the ATE of the keyframes and of all frames [cm]."""
    return keyframe_error(clip, tracker), error(clip, pose_all_frames(tracker, clip))


def keyframe_error(clip: Clip, tracker: Tracker) -> float:
    """Return the ATE of the keyframes [cm]."""
    numbers = [frame.frame_index for frame in tracker.keyframes.frames]
    return error(clip, dict(zip(numbers, tracker.keyframes.T_camera_world, strict=True)))


def error(clip: Clip, poses: dict[int, Tensor]) -> float:
    """Return the ATE [cm] of poses T_camera_world by frame."""
    times = clip.timestamps[list(poses)]
    estimate = Trajectory(times, se3_inverse(torch.stack(list(poses.values()))).numpy())
    truth = Trajectory(times, clip.T_world_camera[list(poses)])
    return 100 * float(absolute_trajectory_error(estimate, truth).statistics["rmse"])


class _Numbered(EncodedFrame):
    def __init__(self, image: Tensor, number: int) -> None:
        self.image = image
        shape = [-(-side // STRIDE) for side in image.shape[:2]]
        self.features = torch.full((1, 1, *shape), float(number))

    @property
    def context(self) -> tuple[Tensor, Tensor]:
        """Return the first hidden state, which counts the updates of an edge."""
        return torch.zeros_like(self.features), torch.zeros_like(self.features)


class _NoWeights:
    device = "cpu"


def _key(image: Tensor) -> int:
    return zlib.crc32(image.contiguous().numpy().tobytes())
