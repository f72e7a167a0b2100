"""The tracker: follows the camera, keeps keyframes, and has them adjusted (paper Sec. 3.3)."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

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
from minislam.tracking.backend import BackEnd
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.initialisation import (
    best_hypothesis,
    carry_disparities,
    chain_state,
    first_disparity_hypotheses,
    start_pose,
)


class TrackingStatus(Enum):
    """What the tracker knows about one frame."""

    OK = "ok"
    LOST = "lost"


@dataclass(frozen=True)
class TrackedFrame:
    """The tracker's word on one frame."""

    frame_index: int
    timestamp: float  # second
    status: TrackingStatus
    matched_share: float  # of the last keyframe, [-]


class Tracker:
    """Turns frames into keyframes with poses and disparities."""

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        flow: FlowEstimator,
        features: FeatureExtractor,
        depth_prior: DepthPrior,
        predict_static_weight: Callable[[int], Tensor],  # keyframe index -> (h, w) in [0, 1]
    ) -> None:
        self.config = config
        self.backend = BackEnd(camera, config, flow)
        self.keyframes = self.backend.keyframes
        self.grid = self.backend.grid
        self.tracked: list[TrackedFrame] = []
        self.initialised = False
        self._features, self._depth_prior = features, depth_prior
        self._predict_static_weight = predict_static_weight
        self._chain: FlowChain | None = None
        self._passed_over: tuple[Frame, FlowMatches] | None = None  # newest frame, no keyframe
        self._steps: list[FlowMatches] = []  # keyframe k to k + 1

    # One frame ----------------------------------------------------------------------------------

    def track(self, frame: Frame) -> bool:
        """Follow the camera into the next frame; return whether there are new keyframes."""
        if self._chain is None:
            self._chain = self.backend.flow.start_chain(frame.image)
            identity = torch.eye(4, dtype=torch.float64)
            self._add_keyframe(frame, identity, torch.ones(len(self.grid.rays)))
            self._log(frame, TrackingStatus.OK, 1.0)
            return True
        chain, matches = self._chain.advanced(frame.image)
        added = False
        if not self._is_followed(matches) and self._passed_over is not None:
            # Too far from the last keyframe, but perhaps not from the last frame: make that one
            # a keyframe after all and go on from there.
            self._insert(*self._passed_over)
            chain, matches = self._chain.advanced(frame.image)
            added = True
        share = float(matches.matched_shares)
        if not self._is_followed(matches):
            # The chain stays where the view was last seen, so that it can be taken up again.
            self._log(frame, TrackingStatus.LOST, share)
            return added
        self._chain = chain
        self._log(frame, TrackingStatus.OK, share)
        self._passed_over = (frame, matches)
        if not self._is_keyframe(frame, matches):
            return added
        self._insert(frame, matches)
        return True

    def _is_followed(self, matches: FlowMatches) -> bool:
        return float(matches.matched_shares) >= self.config.min_matched_share

    def _is_keyframe(self, frame: Frame, matches: FlowMatches) -> bool:
        lengths = (matches.targets.reshape(-1, 2) - self.grid.pixels).norm(dim=1)
        confidence = matches.confidences.reshape(-1, 2)[:, 0]
        mean_flow = float((confidence * lengths).sum() / confidence.sum())
        if mean_flow > self.backend.keyframe_flow:
            return True
        if float(matches.matched_shares) < self.config.keyframe_share:
            return True
        # Without a depth prior the first keyframes need parallax more than they need each other.
        may_force = self.initialised or self.keyframes.has_prior
        elapsed = frame.frame_index - self.keyframes.frames[-1].frame_index
        return may_force and elapsed >= self.config.keyframe_interval

    def _insert(self, frame: Frame, matches: FlowMatches) -> None:
        """Make a frame a keyframe: pose from its flow, disparities from its predecessor."""
        last, disparities = self.keyframes.T_camera_world[-1], self.keyframes.disparities[-1]
        self._chain, self._passed_over = self._chain.restarted(), None
        self._steps.append(matches)
        if not self.initialised:
            # Poses of the warm-up are all estimated together, in initialise().
            self._add_keyframe(frame, last, disparities)
            return
        before = self.keyframes.T_camera_world[-2]
        starts = [last, se3_interpolate(before, last, 2.0)]
        trust = self.keyframes.static_weights[-1]
        pose, _ = start_pose(
            self.grid, matches, disparities, trust, last, starts, self.backend.robust_scale
        )
        carried = carry_disparities(self.grid, pose @ se3_inverse(last), disparities)
        self._add_keyframe(frame, pose, carried)
        self.backend.adjust_newest(self._steps)

    def _add_keyframe(self, frame: Frame, pose: Tensor, carried: Tensor) -> None:
        metric_depth = self._depth_prior(frame, self.grid.camera)
        prior = torch.zeros_like(carried)
        if metric_depth is not None:
            depth = metric_depth[:: self.grid.stride, :: self.grid.stride].reshape(-1)
            prior = torch.where(depth > 0, depth.clamp_min(1e-6).reciprocal(), prior)
        disparities = torch.where(prior > 0, prior, carried)
        index = len(self.keyframes)
        features = self._features(frame)
        self.keyframes.append(frame, features, metric_depth, pose, disparities, prior)
        self.backend.flow.add_frame(index, frame.image)
        if self.initialised:
            self.update_static_weights(first=index)

    def _log(self, frame: Frame, status: TrackingStatus, share: float) -> None:
        self.tracked.append(TrackedFrame(frame.frame_index, frame.timestamp, status, share))

    # The stages ---------------------------------------------------------------------------------

    def initialise(self) -> None:
        """Estimate the warm-up keyframes together, beta unknown (first of the two stages)."""
        self._require_a_pair()
        count = len(self.keyframes)
        for target in range(1, count):
            self.backend.match_from_chain(self._steps, target)
        states = [
            chain_state(
                self.grid,
                self._steps,
                first,
                self.keyframes.prior_disparities,
                self.backend.robust_scale,
            )
            for first in self._first_disparities()
        ]
        problem = self.backend.problem(range(len(self.backend.graph)), first_free=0)
        self.backend.state = best_hypothesis(problem, states)
        self.initialised = True
        both_ways = neighbourhood_edges(0, count, self.config.neighbourhood)
        self._warm_up(both_ways, self.config.warmup_rounds)
        if not self.keyframes.has_prior:
            self.backend.normalise_scale()

    def refine_initialisation(self) -> None:
        """Adjust the warm-up keyframes again, now that beta is known (second stage)."""
        self.update_static_weights()
        self._warm_up(self.backend.graph.edges(), self.config.warmup_rounds_with_beta)

    def finish(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Adjust all keyframes together, with the newest beta."""
        self.update_static_weights()
        self.backend.adjust_all(progress)

    def update_static_weights(self, first: int = 0) -> None:
        """Ask beta again how far each cell of the keyframes from `first` on can be trusted."""
        if not (self.keyframes.has_prior or self.config.beta_without_prior):
            return
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
        from_first = self.backend.graph.measured_from(0)
        return list(first_disparity_hypotheses(self.grid, from_first))
