"""The interfaces of flow, features and depth.

Each has an implementation that needs no weights. A pretrained network can replace it, and nothing
else changes. Images are on the device of the run, and answers come back on it.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from minislam.geometry import Camera
from minislam.records import Frame
from minislam.state.stateful import FrameOf, Tree


@dataclass(frozen=True)
class FlowMatches:
    """Where the grid cells of source frames are seen in target frames."""

    targets: Tensor  # (E, 2, N) px, the matched position of each cell, N = h w, row by row
    confidences: Tensor  # (E, 2, N) in [0, 1], for u and for v; 0 where there is no match
    matched_ratios: Tensor  # (E,) in [0, 1], how much of what could be matched was matched


class FlowChain(Protocol):
    """Flow from a reference frame to the newest frame, followed without any geometry."""

    def advance(self, image: Tensor) -> tuple["FlowChain", FlowMatches]:
        """Return the chain, and the matches (E = 1), from the reference to this next image."""

    def restart(self) -> "FlowChain":
        """Return a chain whose reference is the newest image of this one."""


class FlowEstimator(Protocol):
    """Dense correspondence between keyframes, started from a prediction.

    An estimator and its chains are also `Stateful` (minislam/state), for a run to be resumed.
    """

    stride: int  # px between neighbouring grid cells
    learned_confidence: bool  # trained through a bundle adjustment: only its ratios count

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        """Register the image (H, W, 3) of a keyframe under its index."""

    def remove_frame(self, keyframe_index: int) -> None:
        """Forget a keyframe."""

    def match(
        self,
        edges_source: list[int],  # (E,) keyframe index
        edges_target: list[int],  # (E,) keyframe index
        predicted_targets: Tensor,  # (E, 2, N) px, present reprojection of every cell
    ) -> FlowMatches:
        """Match every cell of each source frame in the target frame of its edge."""

    def disparity_damping(self, keyframes: int) -> Tensor | None:
        """Return the damping (K, N) of the disparities of all keyframes in Eq. (5) [px^2].

        None: a fraction of the mean diagonal.
        """

    def start_chain(self, image: Tensor) -> FlowChain:
        """Return a chain whose reference is this image (H, W, 3)."""

    def restore_chain(self, state: Tree, frame_of: FrameOf) -> FlowChain:
        """Return the chain whose saved state this is."""


class FeatureExtractor(Protocol):
    """Dense image features, the only input of the uncertainty MLP."""

    stride: int  # px per feature patch
    dimension: int  # C

    def __call__(self, frame: Frame) -> Tensor:
        """Return the features (H // stride, W // stride, C) of a frame's image (H, W, 3)."""


class DepthPrior(Protocol):
    """Metric depth of a single image."""

    def __call__(self, frame: Frame, camera: Camera) -> Tensor | None:
        """Return z-depth (H, W) float32 in world units, 0 where unknown, or None."""


@dataclass(frozen=True)
class Priors:
    """The three estimators that see single images or pairs, without any geometry."""

    flow: FlowEstimator
    features: FeatureExtractor
    depth: DepthPrior
