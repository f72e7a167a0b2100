"""What the slow and the fast renderer share: constants, and the form of their result."""

from typing import NamedTuple

from torch import Tensor

from minislam.geometry import Camera

# World units. Nearer Gaussians are dropped: 1/z would blow them up over the whole image.
NEAR_DEPTH = 0.05
# px^2, added to both variances in the image so that no Gaussian falls between pixels (3DGS).
LOW_PASS_VARIANCE = 0.3
# The largest opacity of one Gaussian; keeps 1 - alpha away from zero (3DGS).
MAX_OPACITY = 0.99
# Smaller alphas are dropped: they change a pixel by less than one step of an 8-bit image (3DGS).
MIN_ALPHA = 1 / 255
# The projection is linearised at most this fraction of a half-image outside the border, because
# the approximation becomes poor there and grows without bound (3DGS: 1.3 from the centre).
VIEW_MARGIN = 0.3


class Rendering(NamedTuple):
    """One view of a map. `color`, `depth` and `opacity` carry gradients."""

    color: Tensor  # (H, W, 3)
    depth: Tensor  # (H, W) sum of weight * z in world units, NOT divided by the opacity
    opacity: Tensor  # (H, W) in [0, 1], 1 - transmittance
    weight_sums: Tensor  # (N,) px, blending weight T alpha summed over all pixels; 0: invisible


def tangent_limits(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the smallest and the largest (x/z, y/z) at which the projection is linearised."""
    margin_x = VIEW_MARGIN * camera.width / 2
    margin_y = VIEW_MARGIN * camera.height / 2
    lower = ((-0.5 - margin_x - camera.cx) / camera.fx, (-0.5 - margin_y - camera.cy) / camera.fy)
    right, bottom = camera.width - 0.5 + margin_x, camera.height - 0.5 + margin_y
    return lower, ((right - camera.cx) / camera.fx, (bottom - camera.cy) / camera.fy)
