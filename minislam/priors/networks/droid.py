"""DROID-SLAM's network behind the `FlowEstimator` interface, as in the paper.

An edge keeps the hidden state of its recurrent unit as long as every call includes the edge. So a
later result refines the earlier ones, while the geometry improves between the calls.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.parameters import parameter
from minislam.priors.interfaces import FlowMatches
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.droid_network import (
    LEVELS,
    STRIDE,
    EncodedFrames,
    cell_grid,
    correlation_pyramid,
    encode,
    look_up,
    update,
)
from minislam.priors.networks.vit import normalise
from minislam.state.stateful import FrameOf, Stateful, Tree, from_tree, to_tree

_SMALLEST_GRID = 2 ** (LEVELS - 1)  # cells; the coarsest correlation level needs one of its own


@dataclass(frozen=True)
class DroidFlowConfig:
    """How much work the network is given."""

    updates: int = parameter(
        2, "updates per match; with two rounds of flow and BA it makes the 4 of a CPU profile"
    )
    chain_updates: int = parameter(3, "updates per frame while following the camera")
    edges_per_batch: int = parameter(8, "edges in one pass, bounds the memory of correlations")
    matched_confidence: float = parameter(
        0.1, "least confidence of a cell that counts as matched [-], a guess without real weights"
    )


@dataclass(frozen=True)
class _EdgeState:
    hidden: Tensor  # (128, h, w)
    target: Tensor  # (h, w, 2) cells


class DroidFlow(Stateful):
    """Learned flow between registered keyframes, refined around a predicted reprojection."""

    stride = STRIDE

    def __init__(self, weights: Weights, config: DroidFlowConfig | None = None) -> None:
        self.weights = weights
        self.config = config or DroidFlowConfig()
        self._frames: dict[int, EncodedFrames] = {}
        self._edges: dict[tuple[int, int], _EdgeState] = {}

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        """Register the image (H, W, 3) of a keyframe under its index."""
        self._frames[keyframe_index] = self.encode(image)

    def remove_frame(self, keyframe_index: int) -> None:
        """Forget a keyframe and the edges that touch it."""
        del self._frames[keyframe_index]
        self._edges = {e: state for e, state in self._edges.items() if keyframe_index not in e}

    def saved_state(self) -> Tree:
        """Return the state: of the edges. The frames are encoded again."""
        return {"edges": [[*edge, to_tree(state)] for edge, state in self._edges.items()]}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        """Take up a saved state."""
        self._edges = {(i, j): _EdgeState(**edge) for i, j, edge in state["edges"]}

    @torch.no_grad()
    def match(
        self,
        edges_source: list[int],  # (E,) keyframe index
        edges_target: list[int],  # (E,) keyframe index
        predicted_targets: Tensor,  # (E, 2, N) px
    ) -> FlowMatches:
        """Match every grid cell of each source in its target; see FlowEstimator.match."""
        edges = list(zip(edges_source, edges_target, strict=True))
        height, width = self._frames[edges_source[0]].features.shape[2:]
        expected = predicted_targets.to(self.weights.device, torch.float32) / STRIDE
        expected = expected.mT.reshape(-1, height, width, 2)
        states: dict[tuple[int, int], _EdgeState] = {}
        confidences = []
        for start in range(0, len(edges), self.config.edges_per_batch):
            batch = edges[start : start + self.config.edges_per_batch]
            found, confidence = self._refine(batch, expected[start : start + len(batch)])
            states |= dict(zip(batch, found, strict=True))
            confidences.append(confidence)
        # Edges that are not in this call start anew next time. So memory is bounded.
        self._edges = states
        targets = torch.stack([states[edge].target for edge in edges])
        return self.as_matches(targets, torch.cat(confidences), predicted_targets)

    def _refine(
        self,
        edges: list[tuple[int, int]],
        expected: Tensor,  # (E, h, w, 2) cells
    ) -> tuple[list[_EdgeState], Tensor]:
        """Return the new states of a batch of edges and their confidences (E, h, w, 2)."""
        sources = [self._frames[source] for source, _ in edges]
        targets = torch.cat([self._frames[target].features for _, target in edges])
        known = [self._edges.get(edge) for edge in edges]
        hidden = [
            state.hidden[None] if state else source.hidden
            for state, source in zip(known, sources, strict=True)
        ]
        last = [
            state.target if state else where for state, where in zip(known, expected, strict=True)
        ]
        refined = self.refine(
            EncodedFrames(
                torch.cat([source.features for source in sources]),
                torch.cat(hidden),
                torch.cat([source.context for source in sources]),
            ),
            targets,
            expected,
            torch.stack(last),
            self.config.updates,
        )
        return [_EdgeState(h, t) for h, t in zip(*refined[:2], strict=True)], refined[2]

    def refine(
        self,
        source: EncodedFrames,  # of E edges
        target_features: Tensor,  # (E, 128, h, w)
        expected: Tensor,  # (E, h, w, 2) cells
        last_target: Tensor,  # (E, h, w, 2) cells
        updates: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run updates; return hidden states, targets [cells] and confidences."""
        pyramid = correlation_pyramid(source.features, target_features)
        hidden = source.hidden
        for _ in range(updates):
            correlation = look_up(pyramid, expected)
            answer = update(
                self.weights, hidden, source.context, correlation, expected, last_target
            )
            hidden, last_target = answer.hidden, expected + answer.revision
            expected = last_target  # the best guess until the geometry is updated
        return hidden, last_target, answer.confidence

    @torch.no_grad()
    def encode(self, image: Tensor) -> EncodedFrames:
        """Return features and context of an image (H, W, 3)."""
        if min(image.shape[:2]) <= STRIDE * (_SMALLEST_GRID - 1):
            raise InputError(
                f"expected images of more than {STRIDE * (_SMALLEST_GRID - 1)} px per side for "
                f"DROID, found {image.shape[1]}x{image.shape[0]}; give a larger working size"
            )
        return encode(self.weights, normalise(image, self.weights.device))

    def as_matches(self, targets: Tensor, confidences: Tensor, like: Tensor) -> FlowMatches:
        """Return targets [cells] and confidences (E, h, w, 2) as matches in px, like a tensor."""
        size = targets.new_tensor([targets.shape[2] - 1, targets.shape[1] - 1])
        inside = ((targets >= 0) & (targets <= size)).all(-1)
        matched = inside & (confidences.mean(-1) >= self.config.matched_confidence)
        ratios = matched.float().mean((1, 2))
        targets, confidences = (x.flatten(1, 2).mT.contiguous() for x in (targets, confidences))
        return FlowMatches(*(x.to(like) for x in (STRIDE * targets, confidences, ratios)))

    def start_chain(self, image: Tensor) -> "DroidChain":
        """Return a chain of flows from this image (H, W, 3) to the frames that follow it."""
        return DroidChain(self, self.encode(image), None, None)

    def restore_chain(self, state: Tree, frame_of: FrameOf) -> "DroidChain":
        """Return the chain whose saved state this is."""
        reference = from_tree(EncodedFrames, state["_reference"], frame_of)
        newest = from_tree(EncodedFrames, state["_newest"], frame_of)
        return DroidChain(self, reference, newest, state["_target"])


class DroidChain(Stateful):
    """The flow from one reference frame to the newest; a `FlowChain` that never changes."""

    _reference: EncodedFrames
    _newest: EncodedFrames
    _target: Tensor | None  # (1, h, w, 2) cells, None: nothing has moved yet

    def __init__(
        self,
        flow: DroidFlow,
        reference: EncodedFrames,
        newest: EncodedFrames | None,
        target: Tensor | None,
    ) -> None:
        self._flow = flow
        self._reference = reference
        self._newest = newest or reference
        self._target = target

    @torch.no_grad()
    def advance(self, image: Tensor) -> tuple["DroidChain", FlowMatches]:
        """Return the chain and the matches (E = 1) from the reference to this next image."""
        newest = self._flow.encode(image)
        reference = self._reference
        expected = self._target
        if expected is None:
            height, width = reference.features.shape[2:]
            expected = cell_grid(reference.features.new_zeros(1, height, width, 2))[None]
        updates = self._flow.config.chain_updates
        _, target, confidence = self._flow.refine(
            reference, newest.features, expected, expected, updates
        )
        matches = self._flow.as_matches(target, confidence, image)
        return DroidChain(self._flow, reference, newest, target), matches

    def restart(self) -> "DroidChain":
        """Return a chain that starts at the newest frame."""
        return DroidChain(self._flow, self._newest, None, None)


def build_droid(weights: Weights, config: DroidFlowConfig) -> DroidFlow:
    """Return the flow after one run on a tiny image, which asks for every tensor it needs."""
    flow = DroidFlow(weights, config)
    tiny = torch.zeros(STRIDE * _SMALLEST_GRID, STRIDE * _SMALLEST_GRID, 3)
    flow.start_chain(tiny).advance(tiny)
    return flow
