"""The tracker: estimates the camera's pose frame by frame and keeps keyframes (paper Sec. 3.3)."""

from collections.abc import Callable
from enum import Enum

import torch
from torch import Tensor

from minislam.errors import require
from minislam.geometry import Camera
from minislam.priors.interfaces import (
    DepthPrior,
    FeatureExtractor,
    FlowChain,
    FlowEstimator,
    FlowMatches,
)
from minislam.records import Frame, Progress, TrackedFrame, TrackingStatus
from minislam.state.memory import release
from minislam.state.stateful import FrameOf, Stateful, Tree, to_tree
from minislam.tracking.config import TrackingConfig
from minislam.tracking.disparity_prior import mask_priors
from minislam.tracking.frame_graph import neighbourhood_edges
from minislam.tracking.initialisation import first_geometry
from minislam.tracking.keyframe_graph import NEIGHBOURHOOD, KeyframeGraph
from minislam.tracking.keyframe_selection import needs_keyframe
from minislam.tracking.loop_closure import close_loops
from minislam.tracking.optimisation import final_global_ba, local_ba, online_global_ba, warm_up_ba
from minislam.tracking.safeguards import motion_memory
from minislam.tracking.safeguards.diagnostics import Watch
from minislam.tracking.safeguards.focal_length import seek_focal_length, seek_readouts
from minislam.tracking.safeguards.pose_support import judged_by_pose
from minislam.tracking.safeguards.relocalisation import Place, Relocaliser, attach_newest
from minislam.tracking.safeguards.scale_drift import undo_scale_drift
from minislam.tracking.safeguards.settling import SETTLED, Settling
from minislam.tracking.safeguards.turns import adjust_turns
from minislam.workers import Workers

MIN_MATCHED_RATIO = 0.1  # a frame in which less of the last keyframe is matched is lost [-]
LONGEST_TAIL = 2  # frames after the last keyframe; of more, the last becomes a keyframe, too


class Mode(Enum):
    """What the tracker is doing; the diagram is at Tracker."""

    WAITING = "waiting"
    WARMING_UP = "warming up"
    TRACKING = "tracking"
    LOST = "lost"


class Tracker(Stateful):
    """Turns frames into keyframes with poses and disparities.

        WAITING --first frame--> WARMING_UP --initialise()--> TRACKING --no match--> LOST
                                                                  ^                    |
                                                                  +---- old view or ---+
                                                                       known place

    A frame of the warm-up that cannot be matched is lost, too. With many, `FirstFrame` begins anew.
    """

    graph: KeyframeGraph
    tracked: list[TrackedFrame]
    watch: Watch
    _settling: Settling
    mode: Mode = Mode.WAITING
    last_non_keyframe: tuple[Frame, FlowMatches] | None = None  # if the newest frame is none
    _last_global: int = 0  # keyframes when all were last adjusted, or found to fit

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        flow: FlowEstimator,
        features: FeatureExtractor,
        depth_prior: DepthPrior,
        predict_static_weight: Callable[[int], Tensor],  # keyframe index -> (h, w) in [0, 1]
        device: str = "cpu",  # of all tensors; frames must be there, too
    ) -> None:
        """Start without any frame. Online a keyframe keeps the static weight it came with."""
        self._features = features
        self._depth_prior = lambda frame: depth_prior(frame, camera)  # f as given keeps the unit
        self._predict_static_weight = predict_static_weight
        self.begin_with(KeyframeGraph(camera, config, flow, device))
        self.tracked = []

    def begin_with(self, graph: KeyframeGraph) -> None:
        """Begin, or begin anew, with a graph that has no keyframes yet."""
        self.graph, self.config = graph, graph.config  # for this kind of flow
        self.keyframes, self.grid = graph.keyframes, graph.grid
        self.watch, self._settling = Watch(graph), Settling(graph)
        self._relocaliser = Relocaliser(graph)
        self.mode, self.last_non_keyframe, self._last_global = Mode.WAITING, None, 0
        # From the newest keyframe to the newest frame that could be matched with it.
        self._chain: FlowChain | None = None

    def saved_state(self) -> Tree:
        """Return the state, with that of the chain, which the flow estimator can restore."""
        return super().saved_state() | {"chain": to_tree(self._chain)}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Replace the state by a saved one; give the flow estimator the keyframes' images again."""
        super().restore_state(state, frame_of)
        for index, frame in enumerate(self.keyframes.frames):
            self.graph.flow.add_frame(index, frame.image)
        chain = state["chain"]
        self._chain = None if chain is None else self.graph.flow.restore_chain(chain, frame_of)

    @property
    def initialised(self) -> bool:
        """Tell whether the warm-up is over: there are poses to start from."""
        return self.mode in (Mode.TRACKING, Mode.LOST)

    @property
    def knows_depth(self) -> bool:
        """Tell whether a prior or parallax gives depth, once all keyframes have been judged."""
        return self.keyframes.has_prior or not self.watch.only_turned

    def track(self, frame: Frame) -> bool:
        """Follow the camera into the next frame; tell whether there are new keyframes."""
        count = len(self.keyframes)
        self.graph.shutter.see(frame)
        if self.mode is Mode.WAITING:
            self._begin(frame)
        else:
            self._follow(frame)
        return len(self.keyframes) > count

    def end(self) -> None:
        """Make the last followed frame a keyframe, unless the last keyframe is near."""
        if self.last_non_keyframe is not None:
            last = self.last_non_keyframe[0].frame_index
            if last - self.keyframes.frames[-1].frame_index > LONGEST_TAIL:
                self._insert(*self.last_non_keyframe)

    def _begin(self, frame: Frame) -> None:
        """Make the first frame the first keyframe; its camera frame is the world frame."""
        self.mode = Mode.WARMING_UP
        self._chain = self.graph.flow.start_chain(frame.image)
        ones = torch.ones_like(self.grid.rays[:, 0])
        world = torch.eye(4, device=ones.device)
        self._append(frame, self._features(frame), world, ones)
        self._log_followed(frame, 1.0)

    def _follow(self, frame: Frame) -> None:
        """Match a frame with the newest keyframe; make it a keyframe if it should be one."""
        chain, matches = self._advance(frame)
        ratio = float(matches.matched_ratios)
        if ratio < MIN_MATCHED_RATIO and self.last_non_keyframe is not None:
            # Too far from the last keyframe, but perhaps not from the last frame.
            self._insert(*self.last_non_keyframe)
            chain, matches = self._advance(frame)
            ratio = float(matches.matched_ratios)
        if ratio < MIN_MATCHED_RATIO:
            self._handle_loss(frame, ratio)
            return
        self._chain = chain
        self._log_followed(frame, ratio)
        before, self.last_non_keyframe = self.last_non_keyframe, (frame, matches)
        if needs_keyframe(self.graph, frame, matches, before, self.initialised):
            self._insert(frame, matches)

    def _advance(self, frame: Frame) -> tuple[FlowChain, FlowMatches]:
        """Return the chain extended to this frame, and the flow to it from the newest keyframe."""
        assert self._chain is not None, "there is a chain from the first frame on"
        chain, matches = self._chain.advance(frame.image)
        matches = motion_memory.without_overlay(matches, self.keyframes.overlay)
        return chain, judged_by_pose(self.graph, matches) if self.graph.is_learned else matches

    def _log_followed(self, frame: Frame, ratio: float) -> None:
        if self.initialised:
            self.mode = Mode.TRACKING
        status = TrackingStatus.OK if self.initialised else TrackingStatus.INITIALISING
        self.tracked.append(TrackedFrame(frame.frame_index, frame.timestamp, status, ratio))

    def _insert(self, frame: Frame, matches: FlowMatches) -> None:
        """Make a frame a keyframe: its pose from its flow, its disparities from the last one's."""
        pose, disparities = self.keyframes.T_camera_world[-1], self.keyframes.disparities[-1]
        edge = len(self.keyframes) - 1, len(self.keyframes)
        matches = self.graph.shutter.corrected(matches, [edge], frame.frame_index)
        if self.initialised:  # before, initialise() will estimate all poses together
            information = self._settling.information()
            pose = self.graph.start_pose(matches, self._settling.certainty(information))
            if self.graph.is_learned:
                pose, _ = self.graph.fit_pose(frame, [len(self.keyframes) - 1], pose)
            disparities = self._settling.hand_on(information, pose)
            motion_memory.remember(self.graph, matches, pose, settled=information > SETTLED)
        assert self._chain is not None, "there is a chain from the first frame on"
        self._chain = self._chain.restart()
        self.last_non_keyframe = None
        self.graph.flow_to_next.append(matches)
        self._append(frame, self._features(frame), pose, disparities)
        if self.initialised:
            motion_memory.inherit(self.graph, matches)
            local_ba(self.graph)
            self.watch.judge(first=len(self.keyframes) - 1)
            self._adjust_all_if_due()

    def _append(self, frame: Frame, features: Tensor, pose: Tensor, disparities: Tensor) -> None:
        self.graph.append(frame, features, self._depth_prior(frame), pose, disparities)
        if self.initialised:
            self._update_static_weights(first=len(self.keyframes) - 1)

    def _adjust_all_if_due(self) -> None:
        """Close loops; run online global BA if enough keyframes are new since the last one.

        Enough are at least `global_interval`, and at least half of all.
        """
        interval, count, last = self.config.global_interval, len(self.keyframes), self._last_global
        closed = self.config.loop_closure and close_loops(self.graph, self._relocaliser)
        is_due = interval > 0 and count - last >= max(interval, last)
        if is_due and not closed:
            if not self.graph.focal_is_free:  # in the end, what has drifted may tell none
                seek_focal_length(self.graph)
            seek_readouts(self.graph)
            online_global_ba(self.graph)
        if is_due or closed:
            self._last_global = count

    def _handle_loss(self, frame: Frame, ratio: float) -> None:
        """Look for the camera among all keyframes; keep the chain, should the old view return."""
        if self.initialised:
            self.mode = Mode.LOST
            features = self._features(frame)
            place = self._relocaliser.find(frame.image, features)
            if place is not None and self._resume(frame, place, features):
                return
        status = TrackingStatus.LOST
        self.tracked.append(TrackedFrame(frame.frame_index, frame.timestamp, status, ratio))

    def _resume(self, frame: Frame, place: Place, features: Tensor) -> bool:
        """Make a relocalised frame a keyframe, or return False if its flow does not match."""
        disparities = self.graph.warp_disparities(place.keyframe_index, place.T_camera_world)
        self.graph.flow_to_next.append(None)
        self._append(frame, features, place.T_camera_world, disparities)
        if not attach_newest(self.graph, place.keyframe_index):
            self.graph.remove_newest()
            return False
        self.watch.judge(first=len(self.keyframes) - 1)
        self._chain = self.graph.flow.start_chain(frame.image)
        self.last_non_keyframe = None
        self._log_followed(frame, 1.0)
        return True

    def initialise(self, workers: Workers | None = None) -> None:
        """Estimate the warm-up keyframes together, beta unknown (first of the two stages)."""
        if len(self.keyframes) == 1 and self.last_non_keyframe is not None:
            self._insert(*self.last_non_keyframe)
        found = f"none among {len(self.tracked)} frames; check that they are not blank and overlap"
        require(len(self.keyframes) >= 2, "at least two frames that show the same scene", found)
        first_geometry(self.graph, workers)
        self._settling.fall_back_on_prior()
        self.mode = Mode.TRACKING
        edges = neighbourhood_edges(0, len(self.keyframes), NEIGHBOURHOOD)
        warm_up_ba(self.graph, edges, self.config.warmup_rounds)
        motion_memory.judge_all(self.graph)

    def refine_initialisation(self) -> None:
        """Adjust the warm-up keyframes again, now that beta is known (second stage)."""
        self._update_static_weights()
        edges = self.graph.edges.ends
        mask_priors(self.graph, edges)
        seek_readouts(self.graph)
        warm_up_ba(self.graph, edges, self.config.warmup_rounds_with_beta)
        self.watch.judge()

    def finish(self, progress: Progress | None = None, workers: Workers | None = None) -> None:
        """Run the final global BA, with the newest beta, and with the focal length if unknown."""
        seek_focal_length(self.graph, workers)
        self._update_static_weights()
        motion_memory.judge_all(self.graph)  # online, depths were hardly settled
        seek_readouts(self.graph)
        final_global_ba(self.graph, progress)
        self.conclude()

    def conclude(self) -> None:
        """Undo a drift of the scale and judge all keyframes; without depth, adjust rotations."""
        if not self.config.lambda_disparity_prior:  # else the prior holds the scale itself
            undo_scale_drift(self.graph)
        self.watch.conclude()
        if not self.knows_depth:
            adjust_turns(self.graph)
            motion_memory.judge_all(self.graph)
            self.watch.conclude()

    def _update_static_weights(self, first: int = 0) -> None:
        """Predict the static weights of the keyframes from `first` on, by the present beta."""
        for index in range(first, len(self.keyframes)):
            self.keyframes.static_weights[index] = self._predict_static_weight(index).reshape(-1)
            release()  # its features
