"""The robust weight inside Sigma of Eq. (5), for a flow without a learned confidence.

    weight(r) = (1 + r^2 / c^2)^-k

is the derivative of a loss by r^2. With k = 1 it is Cauchy's loss, which grows like log r, so
that even far outliers pull. With k = 2 it is that of Geman and McClure, bounded by c^2: beyond a
few c only the number of outlier cells counts, not how far a dynamic object has moved.

How wide c must be depends on the noise of the flow: .08 px in clean synthetic clips, .2 to .4 px in
real ones (medians). The residuals of settled poses measure it.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

SETTLED_WIDTH = 3.5  # c over the typical residual of settled poses [-]
MIN_RESIDUAL = 0.05  # px; no flow is more exact, so smaller residuals count as this


@dataclass(frozen=True)
class RobustKernel:
    """A robust loss of squared residuals."""

    scale: float  # c, px
    power: float = 2.0  # k >= 0; 0: least squares

    def weight(self, squared: Tensor) -> Tensor:
        """Return d loss / d r^2, in (0, 1], of squared residuals [px^2]."""
        return (1 + squared / self.scale**2) ** -self.power

    def loss(self, squared: Tensor) -> Tensor:
        """Return the loss [px^2] of squared residuals [px^2]; r^2 for small ones."""
        ratio = squared / self.scale**2
        if self.power == 1:
            return self.scale**2 * torch.log1p(ratio)
        bounded = 1 - (1 + ratio) ** (1 - self.power)
        return self.scale**2 / (self.power - 1) * bounded

    def widened(self, factor: float) -> "RobustKernel":
        """Return the same kernel with `factor` times its scale."""
        return replace(self, scale=factor * self.scale)

    def narrowed(self, residual: float | None) -> "RobustKernel":
        """Return the kernel for the typical residual [px] of settled poses; it is never wider."""
        if residual is None:
            return self
        width = SETTLED_WIDTH * max(residual, MIN_RESIDUAL)
        return replace(self, scale=min(width, self.scale))


def edge_losses(
    weights: Tensor,  # (E, 2, N) without the robust weight
    residual: Tensor,  # (E, 2, N) px
    robust: RobustKernel | None,
) -> Tensor:  # (E,) float64 px^2
    """Return the cost of each edge in Eq. (5): the sum of weighted squares, or of robust losses."""
    if robust is None:
        return (weights * residual.square()).sum((1, 2), dtype=torch.float64)
    return (weights.mean(1) * robust.loss(residual.square().sum(1))).sum(1, dtype=torch.float64)


def least_cost(weights: Tensor) -> float:  # (E, 2, N)
    """Return the cost if every residual had the length MIN_RESIDUAL."""
    return MIN_RESIDUAL**2 * float(weights.mean(1).sum())


def weighted_median(values: Tensor, weights: Tensor) -> float | None:
    """Return the value below which half of the weight lies; None without weight."""
    order = values.flatten().argsort()
    below = weights.flatten()[order].cumsum(0)
    if not below[-1] > 0:  # or NaN
        return None
    return float(values.flatten()[order][torch.searchsorted(below, below[-1] / 2)])
