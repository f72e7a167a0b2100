"""Keyframes as the mapper stores them: one pose, and the image at several sizes."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.images import shrink_depth, shrink_image
from minislam.mapping.safeguards import doubted_error
from minislam.records import Keyframe, Pictured
from minislam.splatting import Rendering
from minislam.state.stateful import FrameOf, Tree
from minislam.uncertainty import RenderingError, UncertaintyConfig, beta_of_mask, rendering_error

MOST_DEPTHS = 100  # keyframes whose depths are sorted together: those of 500 fill 300 MB


@dataclass(frozen=True)
class View:
    """A keyframe at one size."""

    image: Tensor  # (h, w, 3) RGB in [0, 1]
    depth: Tensor  # (h, w) world units, 0 where unknown
    exposure: Tensor | None = None  # (3,) of its keyframe


@dataclass
class MappedKeyframe(Pictured):
    """A keyframe in the map. Bundle adjustment changes its pose."""

    keyframe_index: int
    frame_index: int
    features: Tensor  # (h', w', C)
    pixels: Tensor  # (H, W, 3) as of a `Keyframe`
    depth: Tensor  # (H, W) world units, 0 where unknown
    T_camera_world: Tensor  # (4, 4) float64
    given_beta: Tensor | None = None  # (h, w) instead of the MLP's
    confirmation: Tensor | None = None  # (h', w') in [0, 1], near 1 where several views agree
    exposure: Tensor | None = None  # (3,) as of all that has an image
    _small: dict[tuple[int, int], tuple[Tensor, Tensor]] = field(default_factory=dict)

    @classmethod
    def from_record(cls, keyframe: Keyframe) -> "MappedKeyframe":
        """Return the keyframe for a record of the tracker."""
        mask, depth, pose = keyframe.moving_mask, keyframe.depth, keyframe.T_camera_world.double()
        return cls(
            keyframe.keyframe_index, keyframe.frame_index, keyframe.features, keyframe.pixels,
            depth, pose, None if mask is None else beta_of_mask(mask), keyframe.confirmation,
        )  # fmt: skip

    def saved_state(self) -> Tree:
        """Return all attributes but the image, which is read again, and its copies."""
        images = ("pixels", "_small")
        return {name: value for name, value in vars(self).items() if name not in images}

    @classmethod
    def from_state(cls, state: Tree, frame_of: FrameOf) -> "MappedKeyframe":
        """Return the keyframe of a saved state; its image is read again."""
        return cls(**state, pixels=frame_of(state["frame_index"]).pixels)

    def view(self, camera: Camera) -> View:
        """Return the keyframe at the size of `camera`; a smaller one is computed once."""
        size = (camera.height, camera.width)
        if size == self.depth.shape:
            return View(self.image, self.depth, self.exposure)
        if size not in self._small:
            self._small[size] = shrink_image(self.image, *size), shrink_depth(self.depth, *size)
        return View(*self._small[size], self.exposure)


def median_depth(keyframes: list[Keyframe]) -> float:  # world units
    """Return the median of all known depths; of many keyframes, some tell it."""
    some = keyframes[:: math.ceil(len(keyframes) / MOST_DEPTHS)]
    depths = torch.cat([keyframe.depth[keyframe.depth > 0] for keyframe in some])
    if len(depths) == 0:
        raise InputError(
            "expected some known depth in the first keyframes, found none; the images hold "
            "too little texture or parallax: move the camera more, or give a depth prior"
        )
    return float(depths.median())


@dataclass(frozen=True)
class Comparison:
    """How the MLP compares a keyframe with its rendering.

    All of a run use one size, because the windows of the SSIM are in pixels: at another image
    size the same rendering has another error, and beta learns another value.
    """

    reference: View  # the keyframe at the size at which they are compared
    grid_shape: tuple[int, int]  # (h', w') cells
    confirmation: Tensor | None  # (h', w') of the keyframe
    depth_unit: float  # world units that count as 1 in L_depth
    config: UncertaintyConfig


@torch.no_grad()
def keyframe_rendering_error(rendering: Rendering, how: Comparison) -> RenderingError:
    """Compare a keyframe with its rendering of the same size or a larger one."""
    size = how.reference.depth.shape
    depth_and_opacity = torch.stack([rendering.depth, rendering.opacity], -1)
    depth, opacity = shrink_image(depth_and_opacity, *size).unbind(-1)
    color, reference = shrink_image(rendering.color, *size), how.reference
    grid = how.grid_shape, how.depth_unit, how.config
    error = rendering_error(reference.image, reference.depth, color, depth, opacity, *grid)
    return doubted_error(error, how.confirmation)
