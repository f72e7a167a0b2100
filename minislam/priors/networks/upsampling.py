"""Learned upsampling, as RAFT introduced it: every fine pixel mixes the coarse ones around it."""

from torch import Tensor
from torch.nn import functional


def convex_upsample(
    coarse: Tensor,  # (B, C, h, w)
    logits: Tensor,  # (B, 9 * factor^2, h, w)
    factor: int,
) -> Tensor:  # (B, C, factor * h, factor * w)
    """Upsample: each fine pixel is a convex combination of the 3x3 coarse ones around it."""
    batch, channels, height, width = coarse.shape
    share = logits.view(batch, 1, 9, factor, factor, height, width).softmax(2)
    around = functional.unfold(coarse, 3, padding=1).view(batch, channels, 9, 1, 1, height, width)
    fine = (share * around).sum(2)  # (B, C, factor, factor, h, w)
    return fine.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, factor * height, factor * width)
