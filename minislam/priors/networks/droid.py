"""DROID-SLAM's network behind the `FlowEstimator` interface, as in the paper.

A call updates the flow of its edges once; between two calls the geometry is adjusted. An edge keeps
the hidden state of its recurrent unit from call to call: a later answer refines the earlier ones.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from minislam.errors import require
from minislam.parameters import parameter
from minislam.priors.interfaces import FlowMatches
from minislam.priors.networks import droid_network as net
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.vit import normalise
from minislam.state.stateful import FrameOf, Stateful, Tree

# Sides must be longer [px]: of 8 cells, the coarsest level of the correlations has one.
_TOO_SMALL = net.STRIDE * (2 ** (net.LEVELS - 1) - 1)
# Least confidence of a matched cell, relative to the mean of its edge: the network learned to weigh
# cells against each other in a bundle adjustment, so their ratios have a meaning. [-]
_MATCHED = 0.1
# The official code adds 0.2 eta to C in cells^2, with 0.001 confidence as weight; our C is in px^2.
_DAMPING = 0.2 * net.STRIDE**2 / 0.001


@dataclass(frozen=True)
class DroidFlowConfig:
    """How much work the network is given."""

    chain_updates: int = parameter(
        3, "updates per frame, from the last frame's flow; 1: from the identity, official code", 1
    )
    kept_edges: int = parameter(75, "edges, those used last, that keep their hidden states", 1)
    edges_per_batch: int = parameter(8, "edges in one pass, bounds the memory of correlations", 1)


Edge = tuple[int, int]  # keyframe index of source and target
EdgeState = tuple[Tensor, Tensor]  # of the recurrent unit (128, h, w), last target (h, w, 2) cells


class EncodedFrame:
    """What the encoders make of an image: for a target, and for a source when it becomes one."""

    def __init__(self, weights: Weights, image: Tensor) -> None:
        self.image, self._weights = image, weights  # (H, W, 3)
        normalised = normalise(image.to(weights.device))
        self.features = net.encode_features(weights, normalised)  # (1, 128, h, w)

    @cached_property
    def context(self) -> tuple[Tensor, Tensor]:  # (1, 128, h, w) twice
        """Return the first hidden state and the context of all updates."""
        normalised = normalise(self.image.to(self._weights.device))  # anew: it is not kept
        return net.encode_context(self._weights, normalised)


class DroidFlow(Stateful):
    """Learned flow between registered keyframes, refined around a predicted reprojection."""

    stride = net.STRIDE
    learned_confidence = True

    def __init__(self, weights: Weights, config: DroidFlowConfig = DroidFlowConfig()) -> None:
        self.weights = weights
        self.update, self.damping = partial(net.update, weights), partial(net.damping, weights)
        self.config = config
        self._frames: dict[int, EncodedFrame] = {}
        self._edges: dict[Edge, EdgeState] = {}  # the last ones were used last
        self._dampings: dict[int, Tensor] = {}  # (N,) px^2
        self._newest: EncodedFrame | None = None

    @torch.no_grad()
    def encode(self, image: Tensor) -> EncodedFrame:
        """Return an image (H, W, 3) encoded; chain and keyframe share the newest one."""
        wanted = f"images of more than {_TOO_SMALL} px per side for DROID"
        found = f"{image.shape[1]}x{image.shape[0]}; give a larger working size"
        require(min(image.shape[:2]) > _TOO_SMALL, wanted, found)
        if self._newest is None or not torch.equal(self._newest.image, image):
            self._newest = EncodedFrame(self.weights, image)
        return self._newest

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        self._frames[keyframe_index] = self.encode(image)

    def remove_frame(self, keyframe_index: int) -> None:
        del self._frames[keyframe_index]
        self._dampings.pop(keyframe_index, None)
        self._edges = {e: state for e, state in self._edges.items() if keyframe_index not in e}

    def saved_state(self) -> Tree:
        """Return the state of the edges; the frames are encoded again."""
        edges = [[*edge, *state] for edge, state in self._edges.items()]
        return {"edges": edges, "dampings": [list(item) for item in self._dampings.items()]}

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        self._edges = {(i, j): (hidden, where) for i, j, hidden, where in state["edges"]}
        self._dampings = dict(state["dampings"])

    @torch.no_grad()
    def match(
        self, edges_source: list[int], edges_target: list[int], predicted_targets: Tensor
    ) -> FlowMatches:
        """Update the flow of these edges once; see FlowEstimator.match."""
        edges = list(zip(edges_source, edges_target, strict=True))
        height, width = self._frames[edges_source[0]].features.shape[2:]
        expected = predicted_targets.to(self.weights.device, torch.float32) / net.STRIDE
        expected = expected.mT.reshape(-1, height, width, 2)
        states: dict[Edge, EdgeState] = {}
        confidences = []
        for start in range(0, len(edges), self.config.edges_per_batch):
            batch = slice(start, start + self.config.edges_per_batch)
            hidden, target, confidence = self._update_edges(edges[batch], expected[batch])
            states |= zip(edges[batch], zip(hidden, target, strict=True), strict=True)
            confidences.append(confidence)
        used_last = {e: state for e, state in self._edges.items() if e not in states} | states
        kept = max(self.config.kept_edges, len(states))
        self._edges = dict(list(used_last.items())[-kept:])
        for source in dict.fromkeys(edges_source):
            hidden = torch.stack([states[edge][0] for edge in edges if edge[0] == source])
            self._dampings[source] = _DAMPING * self.damping(hidden).flatten().to(predicted_targets)
        targets = torch.stack([states[edge][1] for edge in edges])
        return as_matches(targets, torch.cat(confidences), predicted_targets)

    def disparity_damping(self, keyframes: int) -> Tensor:  # (K, N) px^2
        unknown = torch.zeros_like(next(iter(self._dampings.values())))
        return torch.stack([self._dampings.get(k, unknown) for k in range(keyframes)])

    def _update_edges(self, edges: list[Edge], expected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Update a batch of edges once, each from its last state."""
        sources = [self._frames[source] for source, _ in edges]
        first_states = zip([source.context[0][0] for source in sources], expected, strict=True)
        states = map(self._edges.get, edges, first_states)  # of new edges the first ones
        hidden, last_target = map(torch.stack, zip(*states, strict=True))
        features = torch.cat([source.features for source in sources])
        of_targets = torch.cat([self._frames[target].features for _, target in edges])
        context = torch.cat([source.context[1] for source in sources])
        return self.update(features, of_targets, hidden, context, expected, last_target)

    def start_chain(self, image: Tensor) -> "DroidChain":
        return DroidChain(self, self.encode(image), self.encode(image))

    def restore_chain(self, state: Tree, frame_of: FrameOf) -> "DroidChain":
        reference, newest = (self.encode(image) for image in state["_images"])
        return DroidChain(self, reference, newest, state["_target"])


@dataclass(frozen=True)
class DroidChain(Stateful):
    """The flow from one reference frame to the newest; a `FlowChain` that never changes."""

    flow: DroidFlow
    reference: EncodedFrame
    newest: EncodedFrame
    target: Tensor | None = None  # (1, h, w, 2) cells, None: nothing has moved yet

    def saved_state(self) -> Tree:
        """Return the target and the images; the frames are encoded again."""
        return {"_images": [self.reference.image, self.newest.image], "_target": self.target}

    @torch.no_grad()
    def advance(self, image: Tensor) -> tuple["DroidChain", FlowMatches]:
        flow, reference, newest = self.flow, self.reference, self.flow.encode(image)
        hidden, context = reference.context
        features = reference.features, newest.features
        target, updates = self.target, flow.config.chain_updates
        if target is None or updates == 1:
            target = net.cell_grid(hidden.new_zeros(1, *hidden.shape[2:], 2))[None]
        for _ in range(updates):
            # Without geometry, the last answer is the best guess.
            hidden, target, confidence = flow.update(*features, hidden, context, target, target)
        return DroidChain(flow, reference, newest, target), as_matches(target, confidence, image)

    def restart(self) -> "DroidChain":
        return DroidChain(self.flow, self.newest, self.newest)


def as_matches(targets: Tensor, confidences: Tensor, like: Tensor) -> FlowMatches:
    """Return targets [cells] and confidences (E, h, w, 2) as matches in px, like a tensor."""
    size = targets.new_tensor([targets.shape[2] - 1, targets.shape[1] - 1])
    inside = ((targets >= 0) & (targets <= size)).all(-1)
    of_cells = confidences.mean(-1)
    matched = inside & (of_cells >= _MATCHED * of_cells.mean((1, 2), keepdim=True))
    ratios = matched.float().mean((1, 2))
    targets, confidences = (x.flatten(1, 2).mT.contiguous() for x in (targets, confidences))
    return FlowMatches(*(x.to(like) for x in (net.STRIDE * targets, confidences, ratios)))
