"""The tracker: follows the camera, keeps keyframes, and has them adjusted (paper Sec. 3.3)."""

from collections.abc import Callable

import torch
from torch import Tensor

from minislam.errors import TrackingLost
from minislam.geometry import Camera, se3_interpolate, se3_inverse
from minislam.priors.interfaces import (
    DepthPrior,
    FeatureExtractor,
    FlowChain,
    FlowEstimator,
    FlowMatches,
)
from minislam.records import Frame
from minislam.state.stateful import FrameOf, Stateful, Tree
from minislam.tracking.backend import BackEnd
from minislam.tracking.config import TrackingConfig
from minislam.tracking.disparity_prior import mask_priors
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.health import KeyframeHealth, health_of
from minislam.tracking.initialisation import (
    best_hypothesis,
    carry_disparities,
    chain_state,
    first_disparity_hypotheses,
    start_pose,
)
from minislam.tracking.loop_closure import close_loops
from minislam.tracking.motion_memory import MotionMemory
from minislam.tracking.relocalisation import Place, Relocaliser
from minislam.tracking.reprojection import lengths
from minislam.tracking.status import TrackedFrame, TrackingStatus


class Tracker(Stateful):
    """Turns frames into keyframes with poses and disparities."""

    backend: BackEnd
    tracked: list[TrackedFrame]
    health: list[KeyframeHealth]  # of every keyframe, when it came
    initialised: bool = False
    _chain: FlowChain | None = None
    _passed_over: tuple[Frame, FlowMatches] | None = None  # newest frame, no keyframe
    _steps: list[FlowMatches | None]  # keyframe k to k + 1, None across a loss
    _lost_in_a_row: int = 0
    _culled_in_a_row: int = 0
    _last_global: int = 0  # keyframes at the last online global BA

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        flow: FlowEstimator,
        features: FeatureExtractor,
        depth_prior: DepthPrior,
        predict_static_weight: Callable[[int], Tensor],  # keyframe index -> (h, w) in [0, 1]
    ) -> None:
        """Start without any frame.

        `predict_static_weight` is called for a new keyframe, and for all keyframes at the end of
        the warm-up and in the final adjustment. So online, a keyframe keeps the beta it had when
        it came, although the MLP learns on.
        """
        self.config = config
        self.backend = BackEnd(camera, config, flow)
        self.keyframes = self.backend.keyframes
        self.grid = self.backend.grid
        self.tracked = []
        self.health = []
        self._features, self._depth_prior = features, depth_prior
        self._predict_static_weight = predict_static_weight
        self._steps = []
        memory_scale = config.motion_memory * self.backend.pixel_scale
        self._motion = MotionMemory(self.grid, self.keyframes, memory_scale)
        self._relocaliser = Relocaliser(self.grid, self.keyframes, self.backend.pixel_scale)

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Take up a saved state; the flow looks at the keyframes' images again."""
        if state["_chain"] is not None:
            # The flow estimator makes a chain of its own class; the state replaces its content.
            self._chain = self.backend.flow.start_chain(frame_of(0).image)
        super().restore_state(state, frame_of)
        for index, frame in enumerate(self.keyframes.frames):
            self.backend.flow.add_frame(index, frame.image)

    # One frame ----------------------------------------------------------------------------------

    def track(self, frame: Frame) -> bool:
        """Follow the camera into the next frame; return whether there are new keyframes."""
        if self._chain is None:
            self._chain = self.backend.flow.start_chain(frame.image)
            identity = torch.eye(4, dtype=torch.float64)
            self._add_keyframe(frame, identity, torch.ones(len(self.grid.rays)))
            self._log(frame, TrackingStatus.OK, 1.0)
            return True
        chain, matches = self._chain.advance(frame.image)
        added = False
        if not self._is_followed(matches) and self._passed_over is not None:
            # Too far from the last keyframe, but perhaps not from the last frame: make that one
            # a keyframe after all and go on from there.
            added = self._insert(*self._passed_over, may_cull=False)
            chain, matches = self._chain.advance(frame.image)
        ratio = float(matches.matched_ratios)
        if not self._is_followed(matches):
            return self._find_again(frame, ratio) or added
        self._chain = chain
        self._log(frame, TrackingStatus.OK, ratio)
        self._passed_over = (frame, matches)
        if not self._is_keyframe(frame, matches):
            return added
        return self._insert(frame, matches) or added

    def _find_again(self, frame: Frame, ratio: float) -> bool:
        """Look for a lost camera among all keyframes; return whether there is a new keyframe.

        The chain stays where the view was last seen, so that it can be taken up again there.
        """
        self._lost_in_a_row += 1
        if self.initialised:
            features = self._features(frame)
            place = self._relocaliser.find(frame.image, features)
            if place is not None and self._resume(frame, place, features):
                return True
        recently = self._lost_in_a_row <= self.config.recently_lost_frames
        self._log(frame, TrackingStatus.RECENTLY_LOST if recently else TrackingStatus.LOST, ratio)
        return False

    def _resume(self, frame: Frame, place: Place, features: Tensor) -> bool:
        """Go on from where a frame was recognised, unless the flow from there says otherwise."""
        keyframes, like = self.keyframes, place.keyframe_index
        T_frame_like = place.T_camera_world @ se3_inverse(keyframes.T_camera_world[like])
        carried = carry_disparities(self.grid, T_frame_like, keyframes.disparities[like])
        self._steps.append(None)
        self._add_keyframe(frame, place.T_camera_world, carried, features)
        if not self.backend.attach_newest(like):
            self._steps.pop()
            keyframes.remove_newest()
            self.backend.flow.remove_frame(len(keyframes))
            return False
        self.health.append(health_of(self.backend, len(self.keyframes) - 1))
        self._chain, self._passed_over = self.backend.flow.start_chain(frame.image), None
        self._log(frame, TrackingStatus.OK, 1.0)
        return True

    def follows_a_loss(self, keyframe_index: int) -> bool:
        """Tell whether the camera was lost between a keyframe and the one before it."""
        return keyframe_index > 0 and self._steps[keyframe_index - 1] is None

    def _is_followed(self, matches: FlowMatches) -> bool:
        return float(matches.matched_ratios) >= self.config.min_matched_ratio

    def _is_keyframe(self, frame: Frame, matches: FlowMatches) -> bool:
        length = lengths(matches.targets - self.grid.pixels.T)[0]
        confidence = matches.confidences[0, 0]
        mean_flow = float((confidence * length).sum() / confidence.sum())
        if mean_flow > self.backend.keyframe_flow:
            return True
        if float(matches.matched_ratios) < self.config.keyframe_matched_ratio:
            return True
        # Without a depth prior the first keyframes need parallax more than they need each other.
        may_force = self.initialised or self.keyframes.has_prior
        elapsed = frame.frame_index - self.keyframes.frames[-1].frame_index
        return may_force and elapsed >= self.config.keyframe_interval

    def _insert(self, frame: Frame, matches: FlowMatches, may_cull: bool = True) -> bool:
        """Make a frame a keyframe: pose from its flow, disparities from its predecessor.

        A frame that moved in the image but not in space is culled: only things moved, and two
        keyframes from one place measure no depth. It stays a frame like others.
        """
        last, disparities = self.keyframes.T_camera_world[-1], self.keyframes.disparities[-1]
        pose, carried = last, disparities
        # Poses of the warm-up are all estimated together, in initialise().
        if self.initialised:
            starts = [last]
            if len(self.keyframes) > 1 and self._steps[-1] is not None:
                before = self.keyframes.T_camera_world[-2]
                starts.append(se3_interpolate(before, last, 2.0))
            trust = self.keyframes.trust[-1]
            pose = start_pose(
                self.grid, matches, disparities, trust, last, starts, self.backend.robust
            )
            carried = carry_disparities(self.grid, pose @ se3_inverse(last), disparities)
            if may_cull and self._is_culled(frame, pose):
                return False
            self._motion.remember(matches, pose)
        self._chain, self._passed_over = self._chain.restart(), None
        self._steps.append(matches)
        self._add_keyframe(frame, pose, carried)
        if self.initialised:
            self._motion.inherit(matches)
            self.backend.adjust_newest(self._steps)
            self.health.append(health_of(self.backend, len(self.keyframes) - 1))
            self._adjust_everything_if_due()
        return True

    def _is_culled(self, frame: Frame, pose: Tensor) -> bool:
        """Tell whether a keyframe would stand where the last one stands (at most 2 in a row)."""
        elapsed = frame.frame_index - self.keyframes.frames[-1].frame_index
        least = self.config.cull_fraction * self.backend.keyframe_flow
        may_cull = self._culled_in_a_row < self.config.max_culled_in_a_row
        is_forced = elapsed >= self.config.keyframe_interval
        if may_cull and not is_forced and self.backend.distance_to_newest(pose) < least:
            self._culled_in_a_row += 1
            return True
        self._culled_in_a_row = 0
        return False

    def _adjust_everything_if_due(self) -> None:
        """Close loops, and every so many keyframes let all of them settle together."""
        config, count = self.config, len(self.keyframes)
        closed = config.loop_closure and close_loops(self.backend)
        is_due = config.global_interval and count - self._last_global >= config.global_interval
        if is_due and not closed:
            self.backend.adjust_so_far()
        if is_due or closed:
            self._last_global = count

    def _add_keyframe(
        self, frame: Frame, pose: Tensor, carried: Tensor, features: Tensor | None = None
    ) -> None:
        metric_depth = self._depth_prior(frame, self.grid.camera)
        prior = torch.zeros_like(carried)
        if metric_depth is not None:
            depth = metric_depth[:: self.grid.stride, :: self.grid.stride].reshape(-1)
            prior = torch.where(depth > 0, depth.clamp_min(1e-6).reciprocal(), prior)
        disparities = torch.where(prior > 0, prior, carried)
        index = len(self.keyframes)
        features = self._features(frame) if features is None else features
        self.keyframes.append(frame, features, metric_depth, pose, disparities, prior)
        self.backend.flow.add_frame(index, frame.image)
        if self.initialised:
            self.update_static_weights(first=index)

    def _log(self, frame: Frame, status: TrackingStatus, ratio: float) -> None:
        if status is TrackingStatus.OK:
            self._lost_in_a_row = 0
            status = status if self.initialised else TrackingStatus.INITIALISING
        self.tracked.append(TrackedFrame(frame.frame_index, frame.timestamp, status, ratio))

    # The stages ---------------------------------------------------------------------------------

    def initialise(self) -> None:
        """Estimate the warm-up keyframes together, beta unknown (first of the two stages)."""
        self._require_a_pair()
        count = len(self.keyframes)
        for target in range(1, count):
            self.backend.match_from_chain(self._steps, target)
        chained = [
            chain_state(
                self.grid,
                self._steps,
                first,
                self.keyframes.prior_disparities,
                self.backend.robust,
                self._motion.scale,
            )
            for first in self._first_disparities()
        ]
        if self._motion.scale is not None:  # then there is a prior and with it one hypothesis
            self.keyframes.motion_trust = chained[0][1]
        problem = self.backend.problem(range(len(self.backend.graph)), first_free=0)
        self.backend.state = best_hypothesis(problem, [state for state, _ in chained])
        self.initialised = True
        both_ways = neighbourhood_edges(0, count, self.config.neighbourhood)
        self._warm_up(both_ways, self.config.warmup_rounds)
        if not self.keyframes.has_prior:
            self.backend.normalise_scale()

    def refine_initialisation(self) -> None:
        """Adjust the warm-up keyframes again, now that beta is known (second stage)."""
        self.update_static_weights()
        edges = self.backend.graph.edges()
        mask_priors(self.keyframes, self.grid, edges, self.config)
        self._warm_up(edges, self.config.warmup_rounds_with_beta)
        self.health = [health_of(self.backend, index) for index in range(len(self.keyframes))]

    def finish(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Adjust all keyframes together, with the newest beta."""
        self.update_static_weights()
        self.backend.adjust_all(progress)

    def update_static_weights(self, first: int = 0) -> None:
        """Ask beta again how far each cell of the keyframes from `first` on can be trusted."""
        for index in range(first, len(self.keyframes)):
            weight = self._predict_static_weight(index)
            self.keyframes.static_weights[index] = weight.reshape(-1)

    def _require_a_pair(self) -> None:
        """Make the newest frame a keyframe if there is only one; without two there is no start."""
        if len(self.keyframes) == 1 and self._passed_over is not None:
            self._insert(*self._passed_over)
        if len(self.keyframes) < 2:
            raise TrackingLost(
                "expected at least two frames that show the same scene, found "
                f"{len(self.tracked)} of which none could be matched with the first; check that "
                "the images are not blank and overlap"
            )

    def _warm_up(self, edges: list[tuple[int, int]], rounds: int) -> None:
        for _ in range(rounds):
            self.backend.match(edges)
            self.backend.adjust(first_free=0, iterations=2 * self.config.iterations)

    def _first_disparities(self) -> list[Tensor]:
        """Return the hypotheses for the first keyframe: its prior if there is one."""
        prior = self.keyframes.prior_disparities[0]
        if bool((prior > 0).any()):
            return [torch.where(prior > 0, prior, prior[prior > 0].median())]
        from_first = self.backend.graph.flow_from(0)
        return list(first_disparity_hypotheses(self.grid, from_first))
