"""The tracker: follows the camera, keeps keyframes, and adjusts them (paper Sec. 3.3)."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from minislam.errors import TrackingLost
from minislam.geometry import Camera, se3_inverse
from minislam.priors.interfaces import (
    DepthPrior,
    FeatureExtractor,
    FlowChain,
    FlowEstimator,
    FlowMatches,
)
from minislam.records import Frame
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleReport,
    BundleState,
    bundle_adjust,
)
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import (
    FrameGraph,
    both_directions,
    flow_distances,
    neighbourhood_edges,
    proximity_pairs,
)
from minislam.tracking.grid import Grid
from minislam.tracking.initialisation import (
    best_hypothesis,
    carry_disparities,
    chain_state,
    compose_matches,
    first_disparity_hypotheses,
    start_pose,
)
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reprojection import relative_transforms, reproject

REFERENCE_DIAGONAL = 400.0  # px, of the 320x240 image that the thresholds in px belong to
HYPOTHESIS_ITERATIONS = 12  # Gauss-Newton steps before hypotheses of the start are compared


class TrackingStatus(Enum):
    """What the tracker knows about one frame."""

    OK = "ok"
    LOST = "lost"


@dataclass(frozen=True)
class TrackedFrame:
    """The tracker's word on one frame."""

    frame_index: int
    timestamp: float
    status: TrackingStatus


class Tracker:
    """Turns frames into keyframes with poses and disparities."""

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        flow: FlowEstimator,
        features: FeatureExtractor,
        depth_prior: DepthPrior,
        predict_static_weight: Callable[[Tensor], Tensor],  # features -> (h, w) in [0, 1]
    ) -> None:
        self.config = config
        self.grid = Grid.of(camera, flow.stride)
        self.keyframes = KeyframeStore(len(self.grid.rays))
        self.graph = FrameGraph()
        self.tracked: list[TrackedFrame] = []
        self.reports: list[BundleReport] = []
        self.initialised = False
        self._flow, self._features, self._depth_prior = flow, features, depth_prior
        self._predict_static_weight = predict_static_weight
        self._chain: FlowChain | None = None
        self._passed_over: tuple[Frame, FlowMatches] | None = None  # newest frame, no keyframe
        self._warmup_matches: list[FlowMatches] = []  # keyframe k to k + 1
        self._pixel_scale = (camera.width**2 + camera.height**2) ** 0.5 / REFERENCE_DIAGONAL
        self._robust_scale = config.robust_scale * self._pixel_scale or None
        self._has_prior = False

    # ---- one frame -------------------------------------------------------------------------

    def track(self, frame: Frame) -> bool:
        """Follow the camera into the next frame; return whether it became a keyframe."""
        if self._chain is None:
            self._chain = self._flow.start_chain(frame.image)
            identity = torch.eye(4, dtype=torch.float64)
            self._add_keyframe(frame, identity, torch.ones(len(self.grid.rays)))
            self._log(frame, TrackingStatus.OK)
            return True
        chain, matches = self._chain.advanced(frame.image)
        added = False
        if not self._is_followed(matches) and self._passed_over is not None:
            # Too far from the last keyframe, but perhaps not from the last frame: make that one
            # a keyframe after all and go on from there.
            self._insert(*self._passed_over)
            chain, matches = self._chain.advanced(frame.image)
            added = True
        if not self._is_followed(matches):
            # The chain stays where the view was last seen, so that it can be taken up again.
            self._log(frame, TrackingStatus.LOST)
            return added
        self._chain = chain
        self._log(frame, TrackingStatus.OK)
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
        if mean_flow > self.config.keyframe_flow * self._pixel_scale:
            return True
        if float(matches.matched_shares) < self.config.keyframe_share:
            return True
        # Without a depth prior the first keyframes need parallax more than they need each other.
        may_force = self.initialised or self._has_prior
        elapsed = frame.frame_index - self.keyframes.frames[-1].frame_index
        return may_force and elapsed >= self.config.keyframe_interval

    def _insert(self, frame: Frame, matches: FlowMatches) -> None:
        last, disparities = self.keyframes.T_camera_world[-1], self.keyframes.disparities[-1]
        self._chain, self._passed_over = self._chain.restarted(), None
        if not self.initialised:
            # Poses of the warm-up are all estimated together, in initialise().
            self._warmup_matches.append(matches)
            self._add_keyframe(frame, last, disparities)
            return
        before = self.keyframes.T_camera_world[-2]
        starts = [last, last @ se3_inverse(before) @ last]
        trust = self.keyframes.static_weights[-1]
        pose, _ = start_pose(
            self.grid, matches, disparities, trust, last, starts, self._robust_scale
        )
        carried = carry_disparities(self.grid, pose @ se3_inverse(last), disparities)
        self._add_keyframe(frame, pose, carried)
        self._local_adjustment()

    def _add_keyframe(self, frame: Frame, pose: Tensor, carried: Tensor) -> None:
        metric_depth = self._depth_prior(frame, self.grid.camera)
        prior = torch.zeros_like(carried)
        if metric_depth is not None:
            self._has_prior = True
            depth = metric_depth[:: self.grid.stride, :: self.grid.stride].reshape(-1)
            prior = torch.where(depth > 0, depth.clamp_min(1e-6).reciprocal(), prior)
        disparities = torch.where(prior > 0, prior, carried)
        index = len(self.keyframes)
        features = self._features(frame.image)
        self.keyframes.append(frame, features, metric_depth, pose, disparities, prior)
        self._flow.add_frame(index, frame.image)
        if self.initialised:
            self.update_static_weights(first=index)

    def _log(self, frame: Frame, status: TrackingStatus) -> None:
        self.tracked.append(TrackedFrame(frame.frame_index, frame.timestamp, status))

    # ---- the stages ------------------------------------------------------------------------

    def initialise(self) -> None:
        """Estimate the warm-up keyframes together, beta unknown (first of the two stages)."""
        count = len(self.keyframes)
        if count < 2:
            raise TrackingLost(
                "expected at least two frames that show the same scene from different places, "
                f"found {len(self.tracked)} frames of which none could be linked to the first; "
                "check that the images are not empty and that the camera moves"
            )
        forward, matches = self._warmup_edges()
        self.graph.record(forward, matches)
        known = self.keyframes.prior_disparities
        scale = self._robust_scale
        states = [
            chain_state(self.grid, self._warmup_matches, first, known, scale)
            for first in self._first_disparities(forward, matches)
        ]
        problem = self._problem(range(len(forward)), first_free=0)
        best, _, _ = best_hypothesis(problem, states, HYPOTHESIS_ITERATIONS)
        self.keyframes.T_camera_world, self.keyframes.disparities = (
            best.T_camera_world,
            best.disparities,
        )
        self.initialised = True
        edges = neighbourhood_edges(0, count, self.config.neighbourhood)
        for _ in range(self.config.warmup_rounds):
            self._match(edges)
            self._adjust(first_free=0, iterations=2 * self.config.iterations)
        if not self._has_prior:
            self._normalise_scale()

    def refine_initialisation(self) -> None:
        """Adjust the warm-up keyframes again, now that beta is known (second stage)."""
        self.update_static_weights()
        for _ in range(self.config.warmup_rounds_with_beta):
            self._match(self.graph.edges())
            self._adjust(first_free=0, iterations=2 * self.config.iterations)

    def finish(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Adjust all keyframes together on fresh flow, without the disparity prior."""
        self.update_static_weights()
        distances = self._distances(range(len(self.keyframes)))
        limit = self.config.final_distance * self._pixel_scale
        everyone = range(len(self.keyframes))
        pairs = proximity_pairs(
            distances, self.graph.edges(), everyone, limit, self.config.final_edges
        )
        edges = self.graph.edges() + both_directions(pairs)
        lambda_prior = self.config.lambda_disparity_prior if self.config.final_prior else 0.0
        for round_index in range(self.config.final_rounds):
            self._match(edges)
            self._adjust(0, self.config.final_iterations, lambda_prior)
            if progress:
                progress(round_index + 1, self.config.final_rounds)

    def update_static_weights(self, first: int = 0) -> None:
        """Ask beta again how far each cell of the keyframes from `first` on can be trusted."""
        for index in range(first, len(self.keyframes)):
            weight = self._predict_static_weight(self.keyframes.features[index])
            self.keyframes.static_weights[index] = weight.reshape(-1)

    # ---- their parts -----------------------------------------------------------------------

    def _warmup_edges(self) -> tuple[list[tuple[int, int]], FlowMatches]:
        """Match each warm-up keyframe with its followers, predicted from flow alone."""
        edges, predictions = [], []
        for source in range(len(self.keyframes) - 1):
            composed = None
            for target in range(source + 1, len(self.keyframes))[: self.config.neighbourhood]:
                step = self._warmup_matches[target - 1]
                composed = step if composed is None else compose_matches(composed, step, self.grid)
                edges.append((source, target))
                predictions.append(composed.targets)
        sources, targets = zip(*edges, strict=True)
        return edges, self._flow.match(list(sources), list(targets), torch.cat(predictions))

    def _first_disparities(
        self, edges: list[tuple[int, int]], matches: FlowMatches
    ) -> list[Tensor]:
        """Return the hypotheses for the first keyframe: its prior if there is one."""
        prior = self.keyframes.prior_disparities[0]
        if bool((prior > 0).any()):
            return [torch.where(prior > 0, prior, prior[prior > 0].median())]
        from_first = [
            FlowMatches(
                matches.targets[p : p + 1],
                matches.confidences[p : p + 1],
                matches.matched_shares[p : p + 1],
            )
            for p, edge in enumerate(edges)
            if edge[0] == 0
        ]
        return list(first_disparity_hypotheses(self.grid, from_first))

    def _local_adjustment(self) -> None:
        """Link the newest keyframe and adjust the window around it."""
        count = len(self.keyframes)
        edges = neighbourhood_edges(count - 1, count, self.config.neighbourhood)
        horizon = range(max(0, count - 3 * self.config.window), count)
        distances = self._distances(horizon)
        taken = [
            (i - horizon.start, j - horizon.start)
            for i, j in self.graph.edges() + edges
            if min(i, j) >= horizon.start
        ]
        newest = range(len(horizon) - 1, len(horizon))
        limit = self.config.proximity_distance * self._pixel_scale
        pairs = proximity_pairs(distances, taken, newest, limit, self.config.proximity_edges)
        edges += both_directions([(i + horizon.start, j + horizon.start) for i, j in pairs])
        first_free = max(0, count - self.config.window)
        for _ in range(self.config.rounds):
            self._match(edges)
            self._adjust(first_free, self.config.iterations)

    def _distances(self, keyframes: range) -> Tensor:
        part = slice(keyframes.start, keyframes.stop)
        return flow_distances(
            self.keyframes.T_camera_world[part],
            self.keyframes.disparities[part],
            self.grid.rays,
            self.grid.pixels,
            self.grid.camera,
            self.config.rotation_share,
        )

    def _match(self, edges: list[tuple[int, int]]) -> None:
        """Measure the flow of these edges, started from what the present geometry predicts."""
        sources, targets = (list(ends) for ends in zip(*edges, strict=True))
        transforms = relative_transforms(self.keyframes.T_camera_world, sources, targets).float()
        predicted, _ = reproject(
            transforms, self.keyframes.disparities[sources], self.grid.rays, self.grid.camera
        )
        # Points near the camera plane project to anywhere; a flow started there finds nothing.
        size = predicted.new_tensor([self.grid.camera.width, self.grid.camera.height])[:, None]
        predicted = torch.minimum(predicted.maximum(-0.5 * size), 1.5 * size)
        predicted = predicted.mT.reshape(len(edges), *self.grid.shape, 2)
        self.graph.record(edges, self._flow.match(sources, targets, predicted))

    def _problem(
        self, positions: list[int] | range, first_free: int, lambda_prior: float | None = None
    ) -> BundleProblem:
        """Collect edges into a bundle problem in which keyframes from `first_free` on move."""
        sources = torch.tensor([self.graph.edges_source[p] for p in positions])
        edges_target = torch.tensor([self.graph.edges_target[p] for p in positions])
        targets = torch.stack([self.graph.targets[p] for p in positions])
        confidences = torch.stack([self.graph.confidences[p] for p in positions])
        static = self.keyframes.static_weights
        # Eq. (5) weighs by beta of the source. A learned confidence also notices a target that
        # is covered by a mover; a classical one does not, so beta of the target counts as well.
        seen = self.grid.sample(static[edges_target][..., None], targets.mT)[..., 0]
        weights = confidences * (static[sources] * seen)[:, None]
        prior = self.keyframes.prior_disparities
        if lambda_prior is None:
            lambda_prior = self.config.lambda_disparity_prior
        strength = lambda_prior * self.grid.camera.fx**2
        free = torch.arange(len(self.keyframes)) >= first_free
        movable = free.clone()
        movable[0] = False  # the first pose is the world
        return BundleProblem(
            camera=self.grid.camera,
            rays=self.grid.rays,
            edges_source=sources,
            edges_target=edges_target,
            targets=targets,
            weights=weights,
            prior_disparities=prior,
            prior_weights=strength * (prior > 0),
            free_poses=movable,
            free_disparities=free,
            robust_scale=self._robust_scale,
        )

    def _adjust(self, first_free: int, iterations: int, lambda_prior: float | None = None) -> None:
        problem = self._problem(self.graph.select(first_free), first_free, lambda_prior)
        state = BundleState(self.keyframes.T_camera_world, self.keyframes.disparities)
        state, report = bundle_adjust(problem, state, iterations)
        self.keyframes.T_camera_world = state.T_camera_world
        self.keyframes.disparities = state.disparities
        self.reports.append(report)

    def _normalise_scale(self) -> None:
        """Choose the unit of length so that the median disparity is one: nothing else fixes it."""
        scale = self.keyframes.disparities.median()
        self.keyframes.disparities /= scale
        self.keyframes.T_camera_world[:, :3, 3] *= float(scale)
