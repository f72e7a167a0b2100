"""Undo a drift of the scale that a depth prior reveals.

Flow ties the scale of a keyframe to that of its neighbours. Where the camera turns fast, few
keyframes see the same, and the scales of distant ones are hardly tied at all: to change them
together with the steps between them costs next to nothing in Eq. (5). A depth prior errs from
keyframe to keyframe, but not more and more. So the ratio of disparities to prior, averaged over
many keyframes, is the drift; the final adjustment does the rest.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.tracking.keyframes import KeyframeStore

SMOOTHED = 8.0  # keyframes, standard deviation of the window
SLOW_ERROR = 0.03  # standard deviation of a prior's error that many keyframes share [-]


def undo_scale_drift(keyframes: KeyframeStore) -> None:
    """Rescale the steps of the camera and the disparities by the drift against the prior."""
    drift = told_drift(keyframes)
    if not drift.any():
        return
    T_world_camera = se3_inverse(keyframes.T_camera_world)
    centres = T_world_camera[:, :3, 3]
    steps = centres.diff(dim=0) * ((drift[1:] + drift[:-1]) / 2).exp()[:, None]
    T_world_camera[1:, :3, 3] = centres[0] + steps.cumsum(0)
    disparities = keyframes.disparities * (-drift).exp().to(keyframes.disparities)[:, None]
    keyframes.set_geometry(se3_inverse(T_world_camera), disparities)


def told_drift(keyframes: KeyframeStore) -> Tensor:  # (K,) float64
    """Return ln(length by the prior / length as estimated) of each keyframe, 0 in the mean.

    The prior's own error is taken off the drift's variance: if it explains all, the drift is 0.
    """
    known = (keyframes.prior_disparities > 0) & (keyframes.disparities > 0)
    has_prior = known.any(1)
    ratio = torch.where(known, keyframes.disparities / keyframes.prior_disparities, torch.nan)
    log_ratio = torch.where(has_prior, ratio.nanmedian(1).values, 1.0).log().double()
    position = torch.arange(len(known), dtype=torch.float64, device=known.device)
    weights = (-0.5 * ((position[:, None] - position) / SMOOTHED) ** 2).exp() * has_prior
    weights = weights / weights.sum(1, keepdim=True).clamp_min(1e-300)
    drift = weights @ log_ratio
    drift = drift - drift.mean()
    # What differs from one keyframe to the next is noise, of which the window leaves little.
    noise = log_ratio[has_prior].diff().square().sum() / 2 / max(1, int(has_prior.sum()) - 1)
    error = SLOW_ERROR**2 + noise * weights.square().sum(1).mean()
    return drift * (1 - error / torch.maximum(drift.square().mean(), error))
