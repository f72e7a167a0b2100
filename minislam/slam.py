"""The whole system (paper Fig. 2): one loop. `Slam.run` shows it on one screen.

    frame -> tracker -> keyframe (pose, disparity) -> mapper -> Gaussian map
                ^                                       |
                |  beta: what the MLP has learned        |
                +---------------------------------------+

The arrow that goes back is a call: the tracker asks `_static_weight` for the weight of each cell,
by the MLP's beta. `_move_map` deforms the map when an adjustment has moved keyframes.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from minislam.config import SlamConfig
from minislam.errors import MinislamError
from minislam.geometry import se3_inverse
from minislam.images import resample
from minislam.mapping import Mapper
from minislam.priors.features import HighResolutionFeatures
from minislam.priors.interfaces import Priors
from minislam.records import Frame, MapImage, Sequence, Trajectory, required_mask
from minislam.state.memory import SHELF
from minislam.state.stateful import Stateful
from minislam.state.steps import Observer, SilentObserver, Steps
from minislam.stereo import dense_structure as dense
from minislam.stereo.second_adjustment import adjust_again
from minislam.tracking.safeguards.exposure import keyframe_exposures, with_exposure
from minislam.tracking.safeguards.first_frame import FirstFrame, has_warmed_up
from minislam.tracking.safeguards.focal_length import FocalLengthFit, check_focal_length
from minislam.tracking.safeguards.lens import LensFit, check_lens
from minislam.tracking.tracker import Tracker
from minislam.tracking.trajectory import as_trajectory, pose_all_frames
from minislam.uncertainty.weights import beta_of_mask, relative_weight, tracking_weight
from minislam.workers import Workers

ONLINE_CELL = 4  # px, side of the square that gets one Gaussian; the final map has its own
FRAMES_AT_ONCE = 8  # whose poses are refined side by side; with more, Ctrl-C waits longer


class Slam(Stateful):
    """Monocular SLAM in a scene with moving objects. Its parts can be read at any time."""

    tracker: Tracker
    mapper: Mapper
    steps: Steps
    first_frame: FirstFrame
    focal_length: FocalLengthFit | None = None  # what the checks at the end have found
    lens: LensFit | None = None
    undone_lens: LensFit | None = None  # by which images are straightened since the run began anew
    poses: dict[int, Tensor]  # T_camera_world of the frames that are not lost, once known

    def __init__(
        self,
        sequence: Sequence,
        config: SlamConfig,
        priors: Priors,
        observer: Observer | None = None,
        save_checkpoint: Callable[[bool], None] = lambda force: None,
        device: str = "cpu",  # of all tensors; the networks are where the priors put them
        workers: Workers | None = None,  # share what is independent; the result is the same
    ) -> None:
        self.sequence, self.device, self.workers = sequence, device, workers or Workers()
        self.config = config
        self.steps = Steps(observer or SilentObserver(), save_checkpoint)
        self._features = HighResolutionFeatures(priors.features, config.uncertainty.grid_factor)
        parts = priors.flow, self._features, priors.depth, self._static_weight
        self.tracker = Tracker(sequence.camera, config.tracking, *parts, device)
        self.tracker.graph.seeks_focal = sequence.refines_focal
        self.mapper = self._new_mapper(ONLINE_CELL)
        self._stride, self.poses, self.first_frame = priors.flow.stride, {}, FirstFrame()

    def run(self) -> None:
        """Process the sequence to the final map, from its start or from a restored state."""
        for frame in self._frames_left():
            with self.steps.timed("tracking"):
                has_new_keyframes = self.tracker.track(frame)
            if has_new_keyframes and self.tracker.initialised:
                self._map_new_keyframes()
            elif has_new_keyframes and has_warmed_up(self.tracker):
                self._initialise()
            self.steps.finish("tracking and mapping", frame.frame_index + 1, len(self.sequence))
        if not self.tracker.initialised:
            self._initialise()

        self.steps.once("final adjustment", self._adjust_all)
        if self.config.uncertainty.enabled and self.tracker.knows_depth:
            self.steps.once("second adjustment", self._adjust_again)
        self.steps.once("all frames", self._pose_all_frames)
        self.steps.once("dense structure", self._rebuild_map)
        self.steps.once("refinement", self._refine_map)
        if self.config.mapping.pose_refinement.enabled:
            self.steps.once("photometric refinement", self._refine_other_poses)

    def _new_mapper(self, cell: int) -> Mapper:
        config, dimension, camera = self.config, self._features.dimension, self.tracker.grid.camera
        parts = camera, config.mapping, config.uncertainty, dimension, config.seed
        return Mapper(*parts, self.device, self.workers, cell)

    def frame(self, frame_index: int) -> Frame:
        """Read a frame; it moves to the device of the run."""
        return self.sequence.frame(frame_index).to(self.device)

    def _frames_left(self) -> Iterator[Frame]:
        """Yield the frames to come. If one cannot be read, the state before it is saved."""
        while (index := self.first_frame.next_frame(self.tracker, len(self.sequence))) is not None:
            try:
                frame = self.frame(index)
            except MinislamError:
                self.steps.save_checkpoint(True)
                raise
            if not len(self.tracker.keyframes) and self.mapper.images:
                self.mapper = self._new_mapper(ONLINE_CELL)  # tracking has begun anew
            yield frame

    def _initialise(self) -> None:
        """Start in two stages (paper supplement): first without beta, then with beta."""
        show = self.steps.on_progress("initialisation")
        show(0, 1)
        with self.steps.timed("initialisation"):
            self.tracker.initialise(self.workers)
        self._map_new_keyframes()
        with self.steps.timed("initialisation"):
            self.tracker.refine_initialisation()
        show(1, 1)

    def _map_new_keyframes(self) -> None:
        """Add new keyframes to the map. Without a depth prior it is built at the end."""
        mapped, store = len(self.mapper.images), self.tracker.keyframes
        if not store.has_prior or mapped == len(store):
            return
        new_keyframes = self.map_images(first=mapped)
        with self.steps.timed("mapping"):
            if mapped:
                self._move_map()
                for keyframe in new_keyframes:
                    self.mapper.integrate(keyframe)
            else:
                self.mapper.camera = self.tracker.grid.camera
                progress = self.steps.on_progress("first map")
                self.mapper.initialise(new_keyframes, progress, online=True)

    def _move_map(self) -> None:
        """Deform the map to follow the keyframes that an adjustment has moved."""
        if mapped := len(self.mapper.images):
            self.mapper.camera = self.tracker.grid.camera
            self.mapper.update_poses(self.tracker.keyframes.T_camera_world[:mapped])

    def _adjust_all(self) -> None:
        self.tracker.end()
        self._map_new_keyframes()
        self.tracker.finish(self.steps.on_progress("final adjustment"), self.workers)
        self._move_map()
        if not self.tracker.watch.only_turned:
            self.lens = check_lens(self.tracker.graph, self.sequence.seeks_lens)

    def _adjust_again(self) -> None:
        """Adjust all keyframes again, on what several views confirm to stand still."""
        adjust_again(self.tracker, self.sequence, self.steps.on_progress, self.workers)
        self._move_map()

    def _rebuild_map(self) -> None:
        """Build map and MLP anew on swept depth, of keyframes and of frames in the gaps."""
        graph, watch = self.tracker.graph, self.tracker.watch
        tracked = [frame.frame_index for frame in graph.keyframes.frames]
        poses = watch.longest_piece(self.poses)
        known = [index for index in tracked if index in poses]
        frames = dense.swept_frames(known, list(poses), least=1)
        images = self.map_images(others=sorted({*frames} - {*tracked}))
        images = [image for image in images if image.frame_index in poses]
        if self.tracker.knows_depth:
            how = frames, frames, self.steps.on_progress("dense depth"), self.workers
            swept = dense.dense_depths(dense.SweepPlanner.of(graph, self.sequence, poses), *how)
            images = dense.with_swept_depth(graph.grid.camera, images, swept, watch.hardly_walked)
        else:
            images = dense.on_backdrop(images)
        by_beta = torch.stack([self._static_weight(k).flatten() for k in range(len(tracked))])
        exposures = keyframe_exposures(graph, by_beta)
        self.mapper = self._new_mapper(self.config.mapping.insertion.cell)
        progress = self.steps.on_progress("first map")
        self.mapper.initialise([with_exposure(image, exposures) for image in images], progress)

    def _refine_map(self) -> None:
        stage = "refining the map"
        iterations = self.config.mapping.refinement(len(self.mapper.images))
        self.mapper.refine(iterations, partial(self.steps.finish, stage), self.steps.done(stage))

    def _pose_all_frames(self) -> None:
        """Check the focal length by the adjusted keyframes, then pose the frames between them."""
        if not self.tracker.watch.only_turned:
            self.focal_length = check_focal_length(self.tracker.graph, self.workers)
        progress = self.steps.on_progress("posing all frames")
        self.poses = pose_all_frames(self.tracker, self.sequence, progress)

    def _refine_other_poses(self) -> None:
        """Refine the poses between the keyframes until the rendered map matches the images."""
        stage = "refining the poses"
        keyframes = {frame.frame_index for frame in self.tracker.keyframes.frames}
        others = [i for i in self.tracker.watch.longest_piece(self.poses) if i not in keyframes]
        undo = self.tracker.graph.shutter.undone
        for first in range(self.steps.done(stage), len(others), FRAMES_AT_ONCE):
            undone = [undo(self.frame(i)) for i in others[first : first + FRAMES_AT_ONCE]]
            frames = [with_exposure(frame, self.mapper.exposures) for frame in undone]
            start = [self.poses[frame.frame_index] for frame in frames]
            betas = [self._beta(frame, None) for frame in frames]
            poses = self.mapper.refine_poses(start, [f.levelled for f in frames], betas)
            self.poses |= {f.frame_index: pose for f, pose in zip(frames, poses, strict=True)}
            self.steps.finish(stage, first + len(frames), len(others))

    def _static_weight(self, index: int) -> Tensor:
        """Return the static weight (h, w) of the cells of a keyframe, in (0, 1], by the MLP."""
        # The tracker asks for it when a keyframe comes, at the end of the warm-up and in the final
        # adjustment. Without a depth prior there is no map online, hence no beta but by masks.
        keyframes, uncertainty = self.tracker.keyframes, self.config.uncertainty
        if not (uncertainty.enabled and (uncertainty.given_masks or self.mapper.images)):
            return torch.ones(self.tracker.grid.shape, device=self.device)
        beta = self._beta(keyframes.frames[index], keyframes.features[index])
        weight = tracking_weight(beta, self.sequence.camera, self._stride)
        return weight if uncertainty.given_masks else relative_weight(weight)

    def _beta(self, frame: Frame, features: Tensor | None) -> Tensor:
        """Return the raw beta (h', w') of a frame: from its given mask, or from the MLP."""
        mask = self._given_mask(frame.frame_index)
        if mask is not None:
            return beta_of_mask(mask)
        return self.mapper.predict_beta(self._features(frame) if features is None else features)

    def _given_mask(self, frame_index: int) -> Tensor | None:
        """Return the mask of dynamic objects (H, W), if given masks are used."""
        if not self.config.uncertainty.takes_masks:
            return None
        return torch.from_numpy(required_mask(self.sequence, frame_index)).to(self.device)

    def map_images(self, first: int = 0, others: Iterable[int] = ()) -> list[MapImage]:
        """Return the keyframes from `first` on and other frames, which insert nothing, in order."""
        store = self.tracker.keyframes
        columns = store.frames, store.features, store.metric_depths, store.T_camera_world
        images = [self._view(*row) for row in zip(*(c[first:] for c in columns), strict=True)]
        for frame in map(self.frame, others):
            seen = self._features(frame), None, self.poses[frame.frame_index]
            images.append(replace(self._view(frame, *seen), inserts=False))
        return sorted(images, key=lambda image: image.frame_index)

    def _view(self, frame: Frame, features: Tensor, depth: Tensor | None, pose: Tensor) -> MapImage:
        pixels = self.tracker.graph.shutter.undone(frame).pixels
        if depth is None:  # it is unknown, 0, everywhere
            depth = torch.zeros((), device=self.device).expand(pixels.shape[:2])
        SHELF.put([pixels, features])
        mask = self._given_mask(frame.frame_index)
        return MapImage(frame.frame_index, pixels, features, depth, pose, mask)

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames that were not lost; before the end, those of keyframes."""
        if not self.poses:
            return self.keyframe_trajectory()
        stamps = {t.frame_index: t.timestamp for t in self.tracker.tracked}
        return as_trajectory([stamps[index] for index in self.poses], list(self.poses.values()))

    def keyframe_trajectory(self) -> Trajectory:
        """Return the poses of the keyframes."""
        stamps = [frame.timestamp for frame in self.tracker.keyframes.frames]
        return as_trajectory(stamps, list(self.tracker.keyframes.T_camera_world))

    def render(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the colours (H, W, 3) in [0, 1] of the map, seen from a pose (4, 4)."""
        pose = se3_inverse(torch.from_numpy(T_world_camera))
        return self.mapper.render(pose).color.clamp(0, 1).cpu().numpy()

    def beta_image(self, position: int) -> np.ndarray:
        """Return beta (H, W) of an image of the map; without uncertainty it is 1 everywhere."""
        camera = self.sequence.camera
        if not self.config.uncertainty.enabled:
            return np.ones((camera.height, camera.width), np.float32)
        beta = self.mapper.beta_of(self.mapper.images[position])
        return resample(beta, camera.height, camera.width).cpu().numpy()

    def lost_frames(self) -> list[tuple[int, float, str]]:
        """Return frame index, timestamp and reason of every frame without a pose."""
        lost = [frame for frame in self.tracker.tracked if not frame.status.is_followed]
        return [(frame.frame_index, frame.timestamp, frame.reason) for frame in lost]
