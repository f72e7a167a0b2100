"""The tracker's memory: one row per keyframe, growing as long as the sequence does."""

import torch
from torch import Tensor

from minislam.records import Frame
from minislam.state.stateful import Stateful


class KeyframeStore(Stateful):
    """Everything the tracker knows of its keyframes."""

    frames: list[Frame]
    features: list[Tensor]  # (h', w', C); saved, because a network takes long to compute them
    metric_depths: list[Tensor | None]  # (H, W) D~, 0 where unknown
    T_camera_world: Tensor  # (K, 4, 4)
    disparities: Tensor  # (K, N) 1/world unit
    prior_disparities: Tensor  # (K, N) 1/D~, 0 where unknown
    prior_masks: Tensor  # (K, N) M; False: prior off
    static_weights: Tensor  # (K, N) what beta leaves of a cell's weight
    motion_trust: Tensor  # (K, N) how well a cell has followed the camera

    def __init__(self, cells: int) -> None:
        self.frames = []
        self.features = []
        self.metric_depths = []
        self.T_camera_world = torch.zeros(0, 4, 4, dtype=torch.float64)
        self.disparities = torch.zeros(0, cells)
        self.prior_disparities = torch.zeros(0, cells)
        self.prior_masks = torch.zeros(0, cells, dtype=torch.bool)
        self.static_weights = torch.zeros(0, cells)
        self.motion_trust = torch.zeros(0, cells)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def has_prior(self) -> bool:
        """Tell whether any keyframe came with a depth prior."""
        return any(depth is not None for depth in self.metric_depths)

    @property
    def trust(self) -> Tensor:  # (K, N) in [0, 1]
        """How far each cell counts as static, by what it looks like and by what it did."""
        return self.static_weights * self.motion_trust

    def append(
        self,
        frame: Frame,
        features: Tensor,  # (h', w', C)
        metric_depth: Tensor | None,  # (H, W)
        T_camera_world: Tensor,  # (4, 4)
        disparities: Tensor,  # (N,)
        prior_disparities: Tensor,  # (N,)
    ) -> None:
        """Add one keyframe, at first with full trust in every cell."""
        self.frames.append(frame)
        self.features.append(features)
        self.metric_depths.append(metric_depth)
        self.T_camera_world = torch.cat([self.T_camera_world, T_camera_world[None].double()])
        self.disparities = torch.cat([self.disparities, disparities[None]])
        self.prior_disparities = torch.cat([self.prior_disparities, prior_disparities[None]])
        trusted = torch.ones_like(disparities)
        self.prior_masks = torch.cat([self.prior_masks, trusted[None].bool()])
        self.static_weights = torch.cat([self.static_weights, trusted[None]])
        self.motion_trust = torch.cat([self.motion_trust, trusted[None]])

    def remove_newest(self) -> None:
        """Forget the newest keyframe."""
        for column in (self.frames, self.features, self.metric_depths):
            column.pop()
        self.T_camera_world = self.T_camera_world[:-1]
        self.disparities = self.disparities[:-1]
        self.prior_disparities = self.prior_disparities[:-1]
        self.prior_masks = self.prior_masks[:-1]
        self.static_weights = self.static_weights[:-1]
        self.motion_trust = self.motion_trust[:-1]
