"""Resample between the image and the feature grid, two regular grids over the same area."""

from torch import Tensor
from torch.nn import functional


def resample(
    values: Tensor,  # (h, w)
    height: int,  # rows wanted
    width: int,  # columns wanted
) -> Tensor:  # (height, width)
    """Interpolate a grid bilinearly at the cell centres of another one over the same area.

    Both cover the image evenly: on an image of W px, the centre of column j of w' columns lies at
    (j + 0.5) W / w' - 0.5. Nothing is smoothed before a resampling to fewer cells.
    """
    batch = values[None, None]
    resampled = functional.interpolate(batch, (height, width), mode="bilinear", align_corners=False)
    return resampled[0, 0]
