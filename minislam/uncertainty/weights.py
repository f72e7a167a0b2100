"""The only place where beta becomes a weight.

The paper weights residuals by 1 / beta^2 in Eq. (5) and Eq. (6). The official code, which we
follow here, first stretches beta, then caps the weight in tracking and cuts it in mapping:

    beta_adj = (max(beta_raw, 0.1) + 0.001 - 0.1) * 1.6316 + 0.1,     w = 0.5 / beta_adj^2,
    tracking: w capped at 1,        mapping: w below 0.1 set to 0, and (ours) capped at 5.

So w is 1 in tracking below beta_raw = 0.47, then taken relative to the most static tenth of a frame
(ours). In mapping w is 0 above 1.41, or above less if betas have two modes (mapping/safeguards.py).
"""

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.images import resample

BETA_FLOOR = 0.1  # smallest beta, official: keeps 1 / beta^2 and log beta finite
BETA_OFFSET = 1e-3  # added to the clipped beta, official
# NeRF On-the-go's schedule 1 + x / (1 + (1 - x) (1/s - 2)), s = 0.8; official: fixed at x = 0.3.
DATA_RATE = 1 + 0.3 / (1 + (1 - 0.3) * (1 / 0.8 - 2))  # 1.6316
WEIGHT_SCALE = 0.5  # numerator of the weight, official
TRACKING_CAP = 1.0  # beta may lower the weight that the flow confidence gives, not raise it
BETA_OF_MASK = 2.0 * 5.0**0.5  # of moving pixels in a given mask: what the capped SSIM alone gives
# A smaller weight is set to 0: in many iterations it would paint a dynamic object into the map.
MAPPING_CUT = 0.1
STATIC_FRACTION = 0.1  # ours: so much of a frame counts fully in tracking, whatever its beta [-]
MAPPING_CAP = 5.0  # ours: else plain walls, of least beta, take the weight of all fine detail


def _beta_of(weight: float) -> float:
    """Return the raw beta above the floor that has this weight."""
    beta_adj = (WEIGHT_SCALE / weight) ** 0.5
    return (beta_adj - BETA_FLOOR) / DATA_RATE + BETA_FLOOR - BETA_OFFSET


BETA_CUT, UNIT_BETA = _beta_of(MAPPING_CUT), _beta_of(1.0)


def clipped_beta(beta_raw: Tensor) -> Tensor:
    """Return max(beta_raw, 0.1) + 0.001, the beta of Eq. (4); shape and gradient kept."""
    return beta_raw.clamp_min(BETA_FLOOR) + BETA_OFFSET


def beta_of_mask(moving: Tensor) -> Tensor:
    """Return the raw beta (H, W) for a given mask (H, W) bool, True on moving pixels."""
    return torch.where(moving, BETA_OF_MASK, BETA_FLOOR)


def weight_of(beta: Tensor) -> Tensor:
    """Return w = 0.5 / beta_adj^2 of a clipped beta, of any shape."""
    return WEIGHT_SCALE / ((beta - BETA_FLOOR) * DATA_RATE + BETA_FLOOR) ** 2


def pixel_weight(beta_raw: Tensor, camera: Camera) -> Tensor:
    """Return the weight w (H, W) of the beta of a grid (h', w'), without gradient."""
    return weight_of(resample(clipped_beta(beta_raw.detach()), camera.height, camera.width))


def mapping_weight(
    beta_raw: Tensor,  # (h', w') output of the MLP
    camera: Camera,
    least: float = MAPPING_CUT,  # a smaller weight is 0
) -> Tensor:  # (H, W) 0, or from `least` to 5
    """Return the weight of each pixel in L_render, Eq. (6): 0.5 / beta_adj^2, cut and capped."""
    weight = pixel_weight(beta_raw, camera).clamp_max(MAPPING_CAP)
    return torch.where(weight < least, 0, weight)


def tracking_weight(
    beta_raw: Tensor,  # (h', w') output of the MLP
    camera: Camera,
    stride: int,  # px between grid cells of the tracker
) -> Tensor:  # (ceil(H / stride), ceil(W / stride)) in (0, 1]
    """Return the weight of each tracker cell in Eq. (5), sampled at pixels (stride i, stride j)."""
    return pixel_weight(beta_raw, camera)[::stride, ::stride].clamp_max(TRACKING_CAP)


def relative_weight(weight: Tensor) -> Tensor:  # both (h, w) in (0, 1]
    """Return the weights of a frame relative to those of its most static tenth (ours)."""
    # While the map fits nothing well, beta is large everywhere: only its contrast shows movers.
    return (weight / weight.quantile(1 - STATIC_FRACTION)).clamp_max(TRACKING_CAP)
