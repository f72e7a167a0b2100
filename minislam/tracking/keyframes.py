"""The tracker's store of keyframes: one row each, growing as long as the sequence does."""

import torch
from torch import Tensor

from minislam.records import Frame
from minislam.state.memory import SHELF, give_back_freed
from minislam.state.stateful import FrameOf, Stateful, Tree


class KeyframeStore(Stateful):
    """All data of the tracker's keyframes: every column has one row per keyframe."""

    frames: list[Frame]
    features: list[Tensor]  # (h', w', C); saved, because a network takes long to compute them
    metric_depths: list[Tensor | None]  # (H, W) D~, 0 where unknown
    T_camera_world: Tensor  # (K, 4, 4)
    disparities: Tensor  # (K, N) 1/world unit
    prior_disparities: Tensor  # (K, N) 1/D~, 0 where unknown
    prior_masks: Tensor  # (K, N) M; False: prior off
    static_weights: Tensor  # (K, N) in [0, 1], from beta; in the end times confirmation
    motion_weights: Tensor  # (K, N) in [0, 1], how well a cell's flow has fitted the camera motion
    overlay: Tensor | None = None  # (N,) 0 on what covers every image, such as a logo

    def __init__(self, like: Tensor) -> None:
        """Start empty, for as many cells as a tensor (N,) has, and on its device."""
        self.frames = []
        self.features = []
        self.metric_depths = []
        self.T_camera_world = like.new_zeros(0, 4, 4, dtype=torch.float64)
        self.disparities = self.prior_disparities = like.new_zeros(0, len(like))
        self.static_weights = self.motion_weights = like.new_zeros(0, len(like))
        self.prior_masks = self.disparities.bool()

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        super().restore_state(state, frame_of)
        for frame, *images in zip(self.frames, self.features, self.metric_depths, strict=True):
            SHELF.put([frame.pixels, *images])

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def has_prior(self) -> bool:
        """Tell whether any keyframe came with a depth prior that knows something."""
        return bool((self.prior_disparities > 0).any())

    @property
    def cell_weights(self) -> Tensor:  # (K, N) in [0, 1]
        """Return the weight of each cell: by its appearance (beta) and by its motion so far."""
        return self.static_weights * self.standing_weights

    @property
    def standing_weights(self) -> Tensor:  # (K, N) in [0, 1]
        """Return the weight of each cell by its motion so far; an overlay of the image has none."""
        return self.motion_weights if self.overlay is None else self.motion_weights * self.overlay

    def append(
        self,
        frame: Frame,
        features: Tensor,  # (h', w', C)
        metric_depth: Tensor | None,  # (H, W)
        T_camera_world: Tensor,  # (4, 4)
        disparities: Tensor,  # (N,)
        prior_disparities: Tensor,  # (N,)
    ) -> None:
        """Add one keyframe. Every cell starts with weight one."""
        SHELF.put([frame.pixels, features, metric_depth])
        give_back_freed()  # by the matching and adjusting of the keyframe before
        self.frames.append(frame)
        self.features.append(features)
        self.metric_depths.append(metric_depth)
        self.T_camera_world = torch.cat([self.T_camera_world, T_camera_world[None].double()])
        self.disparities = torch.cat([self.disparities, disparities[None]])
        self.prior_disparities = torch.cat([self.prior_disparities, prior_disparities[None]])
        ones = torch.ones_like(disparities)[None]
        self.prior_masks = torch.cat([self.prior_masks, ones.bool()])
        self.static_weights = torch.cat([self.static_weights, ones])
        self.motion_weights = torch.cat([self.motion_weights, ones])

    def remove_newest(self) -> None:
        """Forget the newest keyframe."""
        for column, rows in vars(self).items():
            if column != "overlay":
                setattr(self, column, rows[:-1])

    def set_geometry(self, T_camera_world: Tensor, disparities: Tensor) -> None:
        """Replace the poses (K, 4, 4) and disparities (K, N) of all keyframes."""
        self.T_camera_world = T_camera_world
        self.disparities = disparities

    def start_from_prior(self) -> None:
        """Take the newest keyframe's prior for its disparities; the first prior gives the unit."""
        known = self.prior_disparities > 0
        if known[-1].any() and not known[:-1].any():
            self.normalise_scale()
        self.take_prior(-1, known[-1])

    def take_prior(self, index: int, cells: Tensor) -> None:
        """Take the prior of a keyframe's cells (N,) bool for their disparities, where known."""
        prior = self.prior_disparities[index]
        self.disparities[index] = torch.where(cells & (prior > 0), prior, self.disparities[index])

    def normalise_scale(self) -> None:
        """Set the unit of length: that of the prior, or else the median disparity becomes one."""
        known = self.prior_disparities > 0
        relative = self.disparities / torch.where(known, self.prior_disparities, 1.0)
        scale = (relative[known] if known.any() else relative).median()
        self.disparities /= scale
        self.T_camera_world[:, :3, 3] *= float(scale)
