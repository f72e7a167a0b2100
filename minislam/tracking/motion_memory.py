"""What has moved is remembered: trust in each cell, carried along with the flow.

While a mover is small, the robust weight alone finds the static part of every step. Once it fills
half of the image it wins the vote, the camera follows it, and beta, which learns from the poses,
then learns the wrong thing. But it was seen to move when it was still small. So each cell keeps
how well it has followed the camera so far, and the cell it flows to inherits that.
"""

import torch
from scipy import ndimage
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.priors.interfaces import FlowMatches
from minislam.tracking.grid import Grid
from minislam.tracking.keyframes import KeyframeStore
from minislam.tracking.reprojection import reproject

MIN_CONFIDENCE = 0.1  # of a match that has a say [-]
# Distrust comes at once, trust comes back slowly: a mover also pauses. [-], share of the new
LOSS_RATE, RECOVERY_RATE = 0.9, 0.1


class MotionMemory:
    """Keeps the trust in the cells of the newest keyframe."""

    def __init__(self, grid: Grid, keyframes: KeyframeStore, scale: float) -> None:
        self._grid, self._keyframes = grid, keyframes
        self._scale = scale  # px, of the residuals that still count; 0: nothing is remembered

    @property
    def scale(self) -> float | None:
        """Return the scale of the residuals [px], None while nothing is remembered."""
        # Without a depth prior structure and motion are found together: neither judges the other.
        return self._scale if self._scale > 0 and self._keyframes.has_prior else None

    def remember(self, matches: FlowMatches, T_camera_world: Tensor) -> None:
        """Note which cells of the newest keyframe follow the camera to its next pose (4, 4)."""
        keyframes, scale = self._keyframes, self.scale
        if scale is None:
            return
        keyframes.motion_trust[-1] = updated_trust(
            self._grid,
            matches,
            keyframes.disparities[-1],
            T_camera_world @ se3_inverse(keyframes.T_camera_world[-1]),
            keyframes.motion_trust[-1],
            scale,
        )

    def inherit(self, matches: FlowMatches) -> None:
        """Give the newest keyframe what is remembered of the cells that flow to its own."""
        if self.scale is not None:
            trust = self._keyframes.motion_trust
            trust[-1] = inherited_trust(self._grid, matches, trust[-2])


def updated_trust(
    grid: Grid,
    matches: FlowMatches,  # E = 1, source to target
    disparities: Tensor,  # (N,) of the source
    T_target_source: Tensor,  # (4, 4)
    trust: Tensor,  # (N,) of the source cells so far, in [0, 1]
    scale: float,  # px, of the residuals that still count as following the camera
) -> Tensor:  # (N,)
    """Return the trust in the source cells after one more step of the camera."""
    motion = T_target_source[None].to(disparities.dtype)
    positions, valid = reproject(motion, disparities[None], grid.rays, grid.camera)
    squared = (positions[0] - matches.targets[0]).square().sum(0)
    agreement = (1 + squared / scale**2) ** -2
    rate = torch.where(agreement < trust, LOSS_RATE, RECOVERY_RATE)
    return torch.where(valid[0] & _has_say(matches), trust.lerp(agreement, rate), trust)


def inherited_trust(grid: Grid, matches: FlowMatches, trust: Tensor) -> Tensor:  # (N,)
    """Return the trust in the target cells: that of the source cells that flow there.

    Where several meet, the least trusted one counts; where none arrives, the nearest that does.
    """
    cells = (matches.targets[0].mT / grid.stride).round().long()
    height, width = grid.shape
    inside = (cells >= 0).all(1) & (cells[:, 0] < width) & (cells[:, 1] < height)
    arrives = inside & _has_say(matches)
    if not bool(arrives.any()):
        return torch.ones_like(trust)
    index = cells[arrives, 1] * width + cells[arrives, 0]
    unknown = torch.full_like(trust, torch.inf)
    inherited = unknown.scatter_reduce(0, index, trust[arrives], "amin").reshape(grid.shape)
    empty = inherited.isinf().numpy()
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return inherited[torch.from_numpy(nearest[0]), torch.from_numpy(nearest[1])].reshape(-1)


def _has_say(matches: FlowMatches) -> Tensor:  # (N,) bool
    return matches.confidences[0].mean(0) > MIN_CONFIDENCE
