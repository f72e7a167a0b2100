"""Classical optical flow as a `FlowEstimator`: between pairs of keyframes, in chains of frames."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from torch import Tensor

from minislam.priors import dense_flow, grid_flow
from minislam.priors.interfaces import FlowMatches
from minislam.state.memory import SHELF, release
from minislam.state.stateful import FrameOf, Stateful, Tree, from_tree
from minislam.state.threads import side_by_side

Edge = tuple[int, int]  # keyframe index of source and target

STRIDE = 8  # px between grid cells, as DROID-SLAM
START_TOLERANCE = 2.0  # px: an edge is measured again if its start has moved by this (median)
# Matched ratio; with less, the motion may be too fast for a chain, and corners give one more start.
# With 0.4 and more, they would follow an umbrella that fills the view. [-]
WEAK = 0.2


class MeasuredEdge(NamedTuple):
    """The flow measured along an edge, and the start it was measured from."""

    start: np.ndarray  # (2, N) px
    targets: np.ndarray  # (h, w, 2) px
    confidence: np.ndarray  # (h, w) in [0, 1)


class ClassicalFlow(Stateful):
    """DIS flow between registered keyframes, started from a predicted reprojection.

    An edge is measured again only if its start has moved, because flow is half the tracking time.
    """

    stride = STRIDE
    learned_confidence = False

    def __init__(self) -> None:
        # Flow is measured side by side in threads of ours: those of OpenCV would compete with
        # them, and take cores that the run was not given. The flow is the same with any number.
        cv2.setNumThreads(1)
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[int, np.ndarray] = {}
        self._measured: dict[Edge, MeasuredEdge] = {}

    def saved_state(self) -> Tree:
        """Return what was measured; the images are given again."""
        return {"measured": [[*edge, *measured] for edge, measured in self._measured.items()]}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        self._measured = {(i, j): self._kept(*parts) for i, j, *parts in state["measured"]}

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        gray = dense_flow.grayscale(image)
        self._images[keyframe_index] = SHELF.array(gray)
        self._textures[keyframe_index] = grid_flow.texture_confidence(gray, self.stride)

    def remove_frame(self, keyframe_index: int) -> None:
        del self._images[keyframe_index], self._textures[keyframe_index]
        self._measured = {e: flow for e, flow in self._measured.items() if keyframe_index not in e}

    def match(
        self, edges_source: list[int], edges_target: list[int], predicted_targets: Tensor
    ) -> FlowMatches:
        edges = list(zip(edges_source, edges_target, strict=True))
        starts = dict(zip(edges, predicted_targets.cpu().numpy().astype(np.float32), strict=True))
        moved = [edge for edge, start in starts.items() if self._has_moved(edge, start)]
        # Each direction checks the other, so both are measured anew, or none.
        pairs = dict.fromkeys((min(edge), max(edge)) for edge in moved)
        both = (({e: starts[e] for e in ((i, j), (j, i)) if e in starts},) for i, j in pairs)
        for measured in side_by_side(self._measure, both):
            self._measured |= {edge: self._kept(*parts) for edge, parts in measured.items()}
        _, targets, confidences = zip(*(self._measured[edge] for edge in edges), strict=True)
        textures = [self._textures[source] for source in edges_source]
        matches = grid_flow.as_matches(targets, confidences, textures, predicted_targets)
        release()
        return matches

    def disparity_damping(self, keyframes: int) -> None:
        """Return None; see FlowEstimator."""

    def _has_moved(self, edge: Edge, start: np.ndarray) -> bool:
        if edge not in self._measured:
            return True
        distance = np.median(np.linalg.norm(start - self._measured[edge].start, axis=0))
        return bool(distance >= START_TOLERANCE)

    def _measure(self, starts: dict[Edge, np.ndarray]) -> dict[Edge, MeasuredEdge]:
        """Measure the one direction of a pair of keyframes, or both: each checks the other."""
        flows: dict[Edge, np.ndarray] = {}
        for (i, j), start in starts.items():
            on_grid = np.ascontiguousarray(start.T).reshape(*self._textures[i].shape, 2)
            dense = dense_flow.dense_from_grid(on_grid, self._images[i].shape, self.stride)
            flows[i, j] = dense_flow.composed_flow(self._images[i], self._images[j], dense)
        measured = {}
        for (i, j), flow in flows.items():
            images, backward = (self._images[i], self._images[j]), flows.get((j, i))
            if backward is None:
                backward = dense_flow.reverse_flow(*images, flow)
            texture = self._textures[i]
            matches = grid_flow.measure_on_grid(*images, flow, backward, texture, self.stride)
            measured[i, j] = MeasuredEdge(starts[i, j], *matches)
        return measured

    def _kept(self, *parts: np.ndarray) -> MeasuredEdge:
        """Return what was measured, on the shelf: in one place, since each takes 2 kB of memory."""
        whole = SHELF.array(np.concatenate([part.ravel() for part in parts]))
        ends = np.cumsum([part.size for part in parts])[:-1]
        kept = zip(np.split(whole, ends), parts, strict=True)
        return MeasuredEdge(*(values.reshape(part.shape) for values, part in kept))

    def start_chain(self, image: Tensor) -> "ClassicalChain":
        gray = dense_flow.grayscale(image)
        zero = np.zeros((*gray.shape, 2), np.float32)
        return ClassicalChain(gray, gray, zero, zero)

    def restore_chain(self, state: Tree, frame_of: FrameOf) -> "ClassicalChain":
        return from_tree(ClassicalChain, state, frame_of)


@dataclass
class ClassicalChain(Stateful):
    """The flow from one reference frame to the newest frame, updated frame by frame.

    The flow to the previous frame predicts the flow to the next one, so that long displacements
    are followed as long as each step is short. A chain never changes: a bad frame can be skipped.
    """

    reference: np.ndarray  # (H, W) uint8
    newest: np.ndarray  # (H, W) uint8
    flow: np.ndarray  # (H, W, 2) px, reference to newest
    increment: np.ndarray  # (H, W, 2) px, how much of it the last frame added

    def advance(self, image: Tensor) -> tuple["ClassicalChain", FlowMatches]:
        gray, stride = dense_flow.grayscale(image), STRIDE
        texture = grid_flow.texture_confidence(self.reference, stride)

        def follow(start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            images = self.reference, gray
            flow = dense_flow.composed_flow(*images, start)
            backward = dense_flow.reverse_flow(*images, flow)
            return flow, *grid_flow.measure_on_grid(*images, flow, backward, texture, stride)

        # A steady hand continues its motion, a shaking one does not. So both starts are tried, and
        # the more confident flow is kept: a wrong one would spoil the starts of all later frames.
        starts = (self.flow,), (self.flow + self.increment,)
        measured = [*side_by_side(follow, starts)]
        if max(m[2].sum() for m in measured) < WEAK * texture.sum():
            step = dense_flow.plane_flow(self.newest, gray)
            measured.append(follow(self.flow + dense_flow.warp(step, self.flow)))
        flow, targets, confidence = max(measured, key=lambda m: m[2].sum())
        chain = ClassicalChain(self.reference, gray, flow, flow - self.flow)
        return chain, grid_flow.as_matches([targets], [confidence], [texture], image)

    def restart(self) -> "ClassicalChain":
        """Return a chain that starts at the newest frame and expects the same motion to go on."""
        zero = np.zeros_like(self.flow)
        return ClassicalChain(self.newest, self.newest, zero, self.increment)
