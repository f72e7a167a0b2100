"""The back-end: keyframes, the graph between them, and their adjustment, Eq. (5)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.geometry.camera import pixel_scale
from minislam.priors.interfaces import FlowEstimator, FlowMatches
from minislam.state.stateful import Stateful
from minislam.tracking.bundle_adjustment import (
    BundleProblem,
    BundleReport,
    BundleState,
    bundle_adjust,
)
from minislam.tracking.config import TrackingConfig
from minislam.tracking.disparity_prior import mask_priors
from minislam.tracking.frame_graph import (
    FrameGraph,
    both_directions,
    flow_distances,
    neighbourhood_edges,
    proximity_pairs,
)
from minislam.tracking.grid import Grid
from minislam.tracking.initialisation import compose_matches
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reprojection import mean_parallax, relative_transforms, reproject
from minislam.tracking.robust import RobustKernel

# A keyframe that has just come may be off by more than the robust weight tolerates: what it is to
# correct would look like outliers. So the weight is wide at first. [-]
FIRST_WIDENING = 8.0
HORIZON = 3  # windows of keyframes among which a new one looks for proximity links


class BackEnd(Stateful):
    """Holds what tracking has estimated, and makes it consistent."""

    keyframes: KeyframeStore
    graph: FrameGraph
    flow: FlowEstimator
    reports: list[BundleReport]
    _first_moved: int = 0

    def __init__(self, camera: Camera, config: TrackingConfig, flow: FlowEstimator) -> None:
        self.config = config
        self.grid = Grid.of(camera, flow.stride)
        self.keyframes = KeyframeStore(len(self.grid.rays))
        self.graph = FrameGraph()
        self.reports = []
        self.pixel_scale = pixel_scale(camera)
        self.flow = flow

    @property
    def robust(self) -> RobustKernel | None:
        """Return the robust weight inside Sigma, None for plain least squares."""
        scale, power = self.config.robust_scale, self.config.robust_power
        # Matching is no more precise in a smaller image: there the scale stays as it is.
        return RobustKernel(scale * max(self.pixel_scale, 1.0), power) if scale > 0 else None

    @property
    def keyframe_flow(self) -> float:
        """Return the mean flow that makes a keyframe [px]."""
        config = self.config
        known = self.keyframes.has_prior
        flow = config.keyframe_flow if known else config.keyframe_flow_without_prior
        return flow * self.pixel_scale

    def adjust_newest(self, steps: list[FlowMatches | None]) -> None:
        """Link the newest keyframe with its like and adjust the window around it.

        `steps` are the chained matches from each keyframe to the next, up to the newest: the
        first flow to the newest keyframe starts from them, not from a pose that may be wrong.
        A step is None where the camera was lost in between.
        """
        count = len(self.keyframes)
        first_free = max(0, count - self.config.window)
        self.match_from_chain(steps, count - 1)
        self.adjust(first_free, self.config.iterations, widening=FIRST_WIDENING)
        edges = self._neighbourhood(count - 1, steps) + self._proximity_links(count - 1)
        mask_priors(self.keyframes, self.grid, edges, self.config, first=count - 1)
        for _ in range(self.config.rounds):
            self.match(edges)
            self.adjust(first_free, self.config.iterations)

    def attach_newest(self, like: int) -> bool:
        """Link the newest keyframe with one that shows the same place, and with its neighbours.

        Return False, and link nothing, if the flow does not confirm that it is the same place.
        """
        newest, radius = len(self.keyframes) - 1, self.config.neighbourhood
        around = range(max(0, like - radius), min(newest, like + radius + 1))
        edges = self.confirmed(both_directions([(newest, index) for index in around]))
        if (newest, like) not in edges:
            return False
        for _ in range(self.config.rounds):
            self.match(edges)
            self.adjust(newest, self.config.iterations, widening=FIRST_WIDENING)
        return True

    def distance_to_newest(self, T_camera_world: Tensor) -> float:  # px
        """Return the flow distance of a pose (4, 4) from the newest keyframe."""
        pair = torch.stack([self.keyframes.T_camera_world[-1], T_camera_world])
        disparities = self.keyframes.disparities[-1:].expand(2, -1)
        grid, share = self.grid, self.config.rotation_weight
        there = flow_distances(pair, disparities, grid.rays, grid.pixels, grid.camera, share)
        return float(there[0, 1])

    def match_from_chain(self, steps: list[FlowMatches | None], target: int) -> None:
        """Measure the flow from the predecessors of a keyframe, started from flow alone."""
        edges, predictions, composed = [], [], None
        for source in range(target - 1, max(-1, target - 1 - self.config.neighbourhood), -1):
            step = steps[source]
            if step is None:  # the camera was lost in between
                break
            composed = step if composed is None else compose_matches(step, composed, self.grid)
            edges.append((source, target))
            predictions.append(composed.targets)
        sources, targets = (list(ends) for ends in zip(*edges, strict=True))
        self.graph.record(edges, self.flow.match(sources, targets, torch.cat(predictions)))

    def _neighbourhood(
        self, keyframe: int, steps: list[FlowMatches | None]
    ) -> list[tuple[int, int]]:
        """Return the edges to the predecessors since the camera was last lost."""
        losses = [k for k in range(keyframe) if steps[k] is None]
        since = losses[-1] + 1 if losses else 0
        edges = neighbourhood_edges(keyframe, keyframe + 1, self.config.neighbourhood)
        return [edge for edge in edges if min(edge) >= since]

    def _proximity_links(self, keyframe: int) -> list[tuple[int, int]]:
        """Return edges to older keyframes that see the same, if their flow can be confirmed.

        A far link starts from geometry that may have drifted; a false one pulls harder than all
        true ones together, so it must be confirmed before it enters.
        """
        start = max(0, keyframe + 1 - HORIZON * self.config.window)
        limit = self.config.proximity_distance * self.pixel_scale
        near = neighbourhood_edges(keyframe, keyframe + 1, self.config.neighbourhood)
        newest = range(keyframe, keyframe + 1)
        pairs = self._proximity_pairs(start, newest, near, limit, self.config.proximity_edges)
        return self.confirmed(both_directions(pairs))

    def confirmed(self, edges: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return those of these new edges whose flow is matched in both directions."""
        if not edges:
            return []
        matches = self._flow_from_geometry(edges)
        ratio = dict(zip(edges, matches.matched_ratios.tolist(), strict=True))
        least = self.config.min_link_ratio
        return [(i, j) for i, j in edges if min(ratio[i, j], ratio[j, i]) >= least]

    def adjust_so_far(self) -> None:
        """Adjust all keyframes together while the sequence goes on (online global BA).

        The flow that is stored serves again, so the cost is that of the new links.
        """
        edges = self._global_links()
        if edges:
            self.match(edges)
        self.adjust(0, self.config.global_iterations)

    def adjust_all(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Adjust all keyframes together on fresh flow (final global BA).

        The disparity prior is off: it has served to start from, and a single image's depth is
        worse than that of many views.
        """
        edges = self.graph.edges() + self._global_links()
        lambda_prior = self.config.lambda_disparity_prior if self.config.final_prior else 0.0
        for done in range(self.config.final_rounds):
            self.match(edges)
            self.adjust(0, self.config.final_iterations, lambda_prior)
            if progress:
                progress(done + 1, self.config.final_rounds)

    def _global_links(self) -> list[tuple[int, int]]:
        """Return further edges among all keyframes, over many baselines."""
        everyone = range(len(self.keyframes))
        limit = self.config.final_distance * self.pixel_scale
        pairs = self._proximity_pairs(0, everyone, [], limit, self.config.final_edges)
        return self.confirmed(both_directions(pairs))

    def match(self, edges: list[tuple[int, int]]) -> None:
        """Measure the flow of these edges again and store it in the graph."""
        self.graph.record(edges, self._flow_from_geometry(edges))

    def _flow_from_geometry(self, edges: list[tuple[int, int]]) -> FlowMatches:
        """Return the flow of these edges, started from what the present geometry predicts."""
        sources, targets = (list(ends) for ends in zip(*edges, strict=True))
        transforms = relative_transforms(self.keyframes.T_camera_world, sources, targets).float()
        predicted, _ = reproject(
            transforms, self.keyframes.disparities[sources], self.grid.rays, self.grid.camera
        )
        # Points near the camera plane project to anywhere; a flow started there finds nothing.
        size = predicted.new_tensor([self.grid.camera.width, self.grid.camera.height])[:, None]
        predicted = torch.minimum(predicted.maximum(-0.5 * size), 1.5 * size)
        return self.flow.match(sources, targets, predicted)

    def adjust(
        self,
        first_free: int,  # keyframes from here on move
        iterations: int,
        lambda_prior: float | None = None,  # None: as configured
        widening: float = 1.0,  # of the robust weight
    ) -> None:
        """Run a bundle adjustment over the edges that touch the free keyframes."""
        problem = self.problem(self.graph.select(first_free), first_free, lambda_prior)
        if self.robust:
            problem = replace(problem, robust=self.robust.widened(widening))
        if first_free > 0:
            # While a camera only turns, its flow says nothing about depth: what depths came with
            # it hold the scale until it moves again.
            known = problem.free_disparities & self._has_parallax(problem)
            problem = replace(problem, free_disparities=known)
        state, report = bundle_adjust(problem, self.state, iterations)
        self.state = state
        self._first_moved = min(self._first_moved, first_free)
        self.reports.append(report)

    def take_first_moved(self) -> int:
        """Return the first keyframe that has moved since this was last asked."""
        first, self._first_moved = self._first_moved, len(self.keyframes)
        return first

    @property
    def state(self) -> BundleState:
        """Poses and disparities of all keyframes."""
        return BundleState(self.keyframes.T_camera_world, self.keyframes.disparities)

    @state.setter
    def state(self, state: BundleState) -> None:
        """Take over poses and disparities of all keyframes."""
        self.keyframes.T_camera_world = state.T_camera_world
        self.keyframes.disparities = state.disparities

    def problem(
        self, positions: Sequence[int], first_free: int, lambda_prior: float | None = None
    ) -> BundleProblem:
        """Collect edges, by their position in the graph, into a bundle problem."""
        sources = torch.tensor([self.graph.edges_source[p] for p in positions])
        edges_target = torch.tensor([self.graph.edges_target[p] for p in positions])
        targets = torch.stack([self.graph.targets[p] for p in positions])
        confidences = torch.stack([self.graph.confidences[p] for p in positions])
        trust = self.keyframes.trust
        # Eq. (5) weighs by beta of the source. A learned confidence also notices a target that
        # is covered by a mover; a classical one does not, so beta of the target counts as well.
        seen = self.grid.sample(trust[edges_target][..., None], targets.mT)[..., 0]
        weights = confidences * (trust[sources] * seen)[:, None]
        prior = self.keyframes.prior_disparities
        if lambda_prior is None:
            lambda_prior = self.config.lambda_disparity_prior
        strength = lambda_prior * self.grid.camera.fx**2
        free = torch.arange(len(self.keyframes)) >= first_free
        movable = free.clone()
        movable[0] = False  # the first camera is the world
        return BundleProblem(
            camera=self.grid.camera,
            rays=self.grid.rays,
            edges_source=sources,
            edges_target=edges_target,
            targets=targets,
            weights=weights,
            prior_disparities=prior,
            prior_weights=strength * (prior > 0) * self.keyframes.prior_masks,
            free_poses=movable,
            free_disparities=free,
            robust=self.robust,
        )

    def parallaxes(self, sources: Tensor, targets: Tensor) -> Tensor:  # (E,), (E,) -> (E,) px
        """Return the mean parallax of edges, as the present geometry has it."""
        transforms = relative_transforms(self.keyframes.T_camera_world, sources, targets).float()
        disparities = self.keyframes.disparities[sources]
        return mean_parallax(transforms, disparities, self.grid.rays, self.grid.camera)

    def _has_parallax(self, problem: BundleProblem) -> Tensor:  # (K,) bool
        """Tell which keyframes are linked with another place, not only with another direction."""
        most = torch.zeros(len(self.keyframes))
        seen = self.parallaxes(problem.edges_source, problem.edges_target)
        most.scatter_reduce_(0, problem.edges_source, seen, "amax")
        return most >= self.config.min_parallax * self.pixel_scale

    def normalise_scale(self) -> None:
        """Choose the unit of length so that the median disparity is one: nothing else fixes it."""
        scale = self.keyframes.disparities.median()
        self.keyframes.disparities /= scale
        self.keyframes.T_camera_world[:, :3, 3] *= float(scale)

    def distances(self, start: int = 0, rows: range | None = None) -> Tensor:  # (K', K') px
        """Return the flow distances between the keyframes from `start` on, of some rows or all."""
        state, grid, share = self.state, self.grid, self.config.rotation_weight
        poses, disparities = state.T_camera_world[start:], state.disparities[start:]
        return flow_distances(poses, disparities, grid.rays, grid.pixels, grid.camera, share, rows)

    def _proximity_pairs(
        self,
        start: int,  # first keyframe to look at
        newer: range,  # keyframes that want links
        edges: list[tuple[int, int]],  # that will be there besides those of the graph
        limit: float,  # px
        links: int,  # per keyframe
    ) -> list[tuple[int, int]]:
        """Return pairs of keyframes that see the same from different places."""
        shifted = range(newer.start - start, newer.stop - start)
        distances = self.distances(start, shifted)
        taken = [
            (i - start, j - start) for i, j in self.graph.edges() + edges if min(i, j) >= start
        ]
        pairs = proximity_pairs(distances, taken, shifted, limit, links)
        return [(i + start, j + start) for i, j in pairs]
