"""The keyframe graph: which keyframes are linked, and the optical flow along each edge.

The edges of a new keyframe lead to its predecessors (neighbourhood) and, if the flow confirms it in
both directions, to older keyframes that see the same place (covisibility, by the flow distance).
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_interpolate, se3_inverse
from minislam.geometry.camera import pixel_scale
from minislam.priors.interfaces import FlowEstimator, FlowMatches
from minislam.records import Frame
from minislam.state.memory import give_back_freed
from minislam.state.stateful import Stateful
from minislam.tracking.bundle_adjustment import BundleReport, bundle_adjust, residuals
from minislam.tracking.bundle_problem import BundleProblem, BundleState
from minislam.tracking.config import TrackingConfig
from minislam.tracking.frame_graph import (
    FAR,
    FrameGraph,
    at_once,
    both_directions,
    flow_distances,
    neighbourhood_edges,
    proximity_pairs,
)
from minislam.tracking.grid import Grid
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.pose_from_flow import (
    compose_matches,
    inverted_targets,
    motion_only_problem,
    start_pose,
    warp_disparities,
)
from minislam.tracking.reprojection import parallax, relative_transforms, reproject
from minislam.tracking.safeguards.robust import RobustKernel
from minislam.tracking.safeguards.rolling_shutter import RollingShutter

Edge = tuple[int, int]  # keyframe index of source and target

NEIGHBOURHOOD = 5  # predecessors that every keyframe is linked with
PROXIMITY_EDGES = 2  # further edges of a new keyframe, nearest by flow distance
PROXIMITY_DISTANCE = 120.0  # px at 320x240, largest flow distance of such an edge
HORIZON = 3  # BA windows of keyframes among which a new one looks for such edges
MIN_EDGE_RATIO = 0.1  # least matched ratio of a far edge [-]
MIN_PARALLAX = 2.0  # px at 320x240; with less on all edges, flow does not measure depth
GLOBAL_EDGES = 6  # further edges per keyframe in a global BA
GLOBAL_DISTANCE = 45.0  # px at 320x240, largest flow distance of such an edge
ROBUST_NARROWING = 0.5  # for frames between keyframes: the structure is known by then [-]
LEAST_WEIGHT = 0.01  # mean weight of cells, below which little is known of such a frame's pose [-]
FULL_FLOW_WEIGHT = 0.75  # eta of the flow distance [-]


class KeyframeGraph(Stateful):
    """The keyframes, the edges between them, and the estimator of the flow along the edges."""

    grid: Grid
    keyframes: KeyframeStore
    # Keyframe k to k + 1 (E = 1), corrected by the readout known then; None across a loss
    flow_to_next: list[FlowMatches | None]
    edges: FrameGraph
    flow: FlowEstimator
    shutter: RollingShutter
    adjustments: int = 0  # that ran
    failed_adjustments: int = 0  # of these, which left the state as it was
    seeks_focal: bool = False  # the focal length is only a first guess
    focal_is_free: bool = False  # it has been estimated; adjustments of all keyframes refine it

    def __init__(
        self, camera: Camera, config: TrackingConfig, flow: FlowEstimator, device: str = "cpu"
    ) -> None:
        self.given = camera, config, flow, device
        self.is_learned = flow.learned_confidence  # then flow and geometry take turns
        self.config = config.for_learned_flow() if self.is_learned else config
        self.grid = Grid.of(camera, flow.stride, device)
        self.keyframes = KeyframeStore(self.grid.rays[:, 0])
        self.flow_to_next = []
        self.edges = FrameGraph()
        is_rolling = self.config.rolling_shutter
        self.shutter = RollingShutter(self.grid, self.keyframes, self.edges, is_rolling)
        self.flow = flow
        self.pixel_scale = pixel_scale(camera)
        self.least_parallax = MIN_PARALLAX * self.pixel_scale  # px, that measures depth

    @property
    def robust(self) -> RobustKernel | None:
        """Return the robust weight inside Sigma, None for plain least squares."""
        scale, power = self.config.robust_scale, self.config.robust_power
        return RobustKernel(scale * max(self.pixel_scale, 1.0), power) if scale > 0 else None

    @property
    def state(self) -> BundleState:
        """Return poses and disparities of all keyframes."""
        return BundleState(self.keyframes.T_camera_world, self.keyframes.disparities)

    def fitting_weights(self, problem: BundleProblem, state: BundleState) -> Tensor:  # (E, 2, N)
        """Return the weights of a problem, lowered by a robust weight where it does not fit."""
        robust = problem.robust or RobustKernel(max(self.pixel_scale, 1.0))  # None if learned
        return residuals(replace(problem, robust=robust), state)[1]

    def count_adjustment(self, report: BundleReport) -> None:
        """Count an adjustment; a run warns at its end of those that failed."""
        self.adjustments += 1
        self.failed_adjustments += not report.converged

    def append(
        self,
        frame: Frame,
        features: Tensor,  # (h', w', C)
        metric_depth: Tensor | None,  # (H, W)
        T_camera_world: Tensor,  # (4, 4)
        disparities: Tensor,  # (N,), used where there is no metric depth
    ) -> None:
        """Add a keyframe and register its image with the flow estimator."""
        prior = torch.zeros_like(disparities)
        if metric_depth is not None:
            depth = metric_depth[:: self.grid.stride, :: self.grid.stride].reshape(-1)
            prior = torch.where(depth > 0, depth.clamp_min(1e-6).reciprocal(), prior)
        self.flow.add_frame(len(self.keyframes), frame.image)
        self.keyframes.append(frame, features, metric_depth, T_camera_world, disparities, prior)
        self.keyframes.start_from_prior()

    def remove_newest(self) -> None:
        """Forget the newest keyframe, which has no edges yet."""
        self.flow_to_next.pop()
        self.keyframes.remove_newest()
        self.flow.remove_frame(len(self.keyframes))

    def follows_a_loss(self, keyframe: int) -> bool:
        """Tell whether the camera was lost between a keyframe and the one before it."""
        return keyframe > 0 and self.flow_to_next[keyframe - 1] is None

    def start_pose(self, matches: FlowMatches, certainty: Tensor) -> Tensor:  # (4, 4)
        """Return T_camera_world of a frame from its flow (E = 1) from the newest keyframe.

        It starts from the pose there, and from the last motion repeated; `certainty` is (N,).
        """
        keyframes, newest = self.keyframes, len(self.keyframes) - 1
        last = keyframes.T_camera_world[newest]
        starts = [last]
        if newest > 0 and not self.follows_a_loss(newest):
            starts.append(se3_interpolate(keyframes.T_camera_world[newest - 1], last, 2.0))
        weights, robust = keyframes.cell_weights[newest] * certainty, self.robust
        disparities = keyframes.disparities[newest]
        return start_pose(self.grid, matches, disparities, weights, last, starts, robust)

    def fit_pose(
        self,
        frame: Frame,  # not among the keyframes
        around: list[int],  # keyframes that may show the same
        start: Tensor,  # (4, 4)
    ) -> tuple[Tensor, float]:
        """Return T_camera_world (4, 4) of an image and its support; flow and pose alternate.

        Support is the robust weight of the flow over the weight of the keyframes' cells. So where
        a dynamic object fills the view, the few static cells are enough.
        """
        keyframes, grid, count = self.keyframes, self.grid, len(around)
        slot = len(keyframes)  # under which the flow knows the frame
        poses, weights = keyframes.T_camera_world[around], keyframes.cell_weights[around]
        robust = self.robust and self.robust.widened(ROBUST_NARROWING)
        numbers = torch.arange(count + 1, device=poses.device)
        ends = numbers[:-1], numbers[-1:].expand(count)
        unused = grid.rays.new_zeros(1, len(grid.rays))  # disparities of the image itself
        disparities = torch.cat([keyframes.disparities[around], unused])
        state = BundleState(torch.cat([poses, start[None]]), disparities)
        self.flow.add_frame(slot, frame.image)
        edges = [(keyframe, slot) for keyframe in around]
        for _ in range(self.config.pose_rounds):
            transforms = relative_transforms(state.T_camera_world, *ends).float()
            predicted, _ = reproject(transforms, disparities[:-1], grid.rays, grid.camera)
            matches = self.flow.match(around, [slot] * count, predicted)
            matches = self.shutter.corrected(matches, edges, frame.frame_index)
            measured = *ends, matches.targets, matches.confidences * weights[:, None]
            problem = motion_only_problem(grid, *measured, numbers == count, robust)
            # One keyframe alone: a narrow robust weight may hold on to a dynamic object.
            if count == 1 and not self.is_learned:
                source, starts = (disparities[0], weights[0], poses[0]), [state.T_camera_world[1]]
                pose = start_pose(grid, matches, *source, starts, self.robust)
                state = BundleState(torch.cat([poses, pose[None]]), disparities)
            state, _ = bundle_adjust(problem, state, self.config.pose_iterations)
        self.flow.remove_frame(slot)
        fitting = self.fitting_weights(problem, state)
        support = fitting.mean() / weights.mean().clamp_min(LEAST_WEIGHT)
        return state.T_camera_world[-1], float(support)

    def warp_disparities(self, keyframe: int, T_camera_world: Tensor) -> Tensor:  # (N,)
        """Warp the disparities of a keyframe to another camera pose (4, 4)."""
        motion = T_camera_world @ se3_inverse(self.keyframes.T_camera_world[keyframe])
        return warp_disparities(self.grid, motion, self.keyframes.disparities[keyframe])

    def match(self, edges: list[Edge]) -> None:
        """Measure the flow of these edges, started from the present geometry, and store it."""
        for part, matches in self._flow_from_geometry(edges):
            self.edges.record(part, matches)

    def match_composed(self, target: int) -> None:
        """Measure the flow between a keyframe and its predecessors, since the last loss.

        It starts from the composed flow between neighbours, so a wrong geometry does no harm.
        """
        edges: list[Edge] = []
        predictions, composed = [], None
        for source in range(target - 1, max(-1, target - 1 - NEIGHBOURHOOD), -1):
            matches = self.flow_to_next[source]
            if matches is None:
                break
            composed = compose_matches(matches, composed, self.grid) if composed else matches
            edges += both_directions([(source, target)])
            predictions += [composed.targets, inverted_targets(composed.targets, self.grid)]
        sources, targets = ([edge[end] for edge in edges] for end in (0, 1))
        matches = self.flow.match(sources, targets, torch.cat(predictions))
        self.edges.record(edges, self.shutter.corrected(matches, edges))

    def filter_confirmed(self, edges: list[Edge]) -> list[Edge]:
        """Return those of these new edges, each with its reverse, that flow matches both ways.

        The flow of a far edge starts from drifted poses; one wrong edge can outweigh all others.
        """
        ratio: dict[Edge, float] = {}
        for part, matches in self._flow_from_geometry(edges):
            ratio |= zip(part, matches.matched_ratios.tolist(), strict=True)
        return [(i, j) for i, j in edges if min(ratio[i, j], ratio[j, i]) >= MIN_EDGE_RATIO]

    def _flow_from_geometry(self, edges: list[Edge]) -> Iterator[tuple[list[Edge], FlowMatches]]:
        """Yield edges, AT_ONCE a time, with their flow, started from the present reprojection.

        Points near the camera plane project far outside the image, so that start is clamped.
        """
        for part in at_once(edges):
            sources, targets = ([edge[end] for edge in part] for end in (0, 1))
            predicted, _ = reproject(*self.geometry(sources, targets))
            size = predicted.new_tensor([self.grid.camera.width, self.grid.camera.height])[:, None]
            predicted = torch.minimum(predicted.maximum(-0.5 * size), 1.5 * size)
            yield part, self.shutter.corrected(self.flow.match(sources, targets, predicted), part)
            if len(part) < len(edges):
                give_back_freed()  # many edges fragment the memory

    def neighbour_edges(self, keyframe: int) -> list[Edge]:
        """Return the edges to the predecessors since the camera was last lost."""
        since = max((k for k in range(keyframe + 1) if self.follows_a_loss(k)), default=0)
        edges = neighbourhood_edges(keyframe, keyframe + 1, NEIGHBOURHOOD)
        return [edge for edge in edges if min(edge) >= since]

    def proximity_edges(self, keyframe: int) -> list[Edge]:
        """Return edges from a new keyframe to covisible older ones."""
        start = max(0, keyframe + 1 - HORIZON * self.config.window)
        newest = range(keyframe, keyframe + 1)
        near = self.neighbour_edges(keyframe)
        return self._covisible_edges(start, newest, near, PROXIMITY_DISTANCE, PROXIMITY_EDGES)

    def global_edges(self, every: int = 1) -> list[Edge]:
        """Return further edges of all keyframes, or one in so many, over many baselines."""
        keyframes = range(0, len(self.keyframes), every)
        return self._covisible_edges(0, keyframes, [], GLOBAL_DISTANCE, GLOBAL_EDGES)

    def _covisible_edges(
        self,
        start: int,  # first keyframe to look at
        newer: range,  # keyframes that get edges
        planned: list[Edge],  # edges about to be added, treated as existing
        limit: float,  # px at 320x240, largest flow distance
        most: int,  # edges per keyframe
    ) -> list[Edge]:
        """Return confirmed edges between covisible keyframes, by increasing flow distance."""
        limit *= self.pixel_scale
        shifted = range(newer.start - start, newer.stop - start, newer.step)
        distances = self.distances(start, shifted, limit)
        taken = [(i - start, j - start) for i, j in self.edges.ends + planned if min(i, j) >= start]
        pairs = proximity_pairs(distances, taken, shifted, limit, most)
        return self.filter_confirmed(both_directions([(i + start, j + start) for i, j in pairs]))

    def distances(self, start: int = 0, rows: range | None = None, limit: float = FAR) -> Tensor:
        """Return the flow distances (K', K') [px] of the keyframes from `start` on."""
        poses, disparities = self.keyframes.T_camera_world, self.keyframes.disparities
        views = poses[start:], disparities[start:], self.grid.rays, self.grid.pixels
        # On the CPU, because pairs are chosen by one number after the other.
        return flow_distances(*views, self.grid.camera, FULL_FLOW_WEIGHT, rows, limit).cpu()

    def parallaxes(self, sources: Tensor | list[int], targets: Tensor | list[int]) -> Tensor:
        """Return the mean parallax (E,) [px] of edges, from the present poses and disparities."""
        means = []
        for part in zip(at_once(sources), at_once(targets), strict=True):
            shift, _, valid = parallax(*self.geometry(*part))
            means.append((shift * valid).sum(1) / valid.sum(1).clamp_min(1))
        return torch.cat(means)

    def geometry(
        self, sources: Tensor | list[int], targets: Tensor | list[int]
    ) -> tuple[Tensor, Tensor, Tensor, Camera]:
        """Return what a reprojection along edges takes: present poses, disparities and cells."""
        transforms = relative_transforms(self.keyframes.T_camera_world, sources, targets).float()
        return transforms, self.keyframes.disparities[sources], self.grid.rays, self.grid.camera
