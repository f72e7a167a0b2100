"""A finer uncertainty map: features of several shifted copies of the image, interleaved.

A network looks at patches of 14 px, so beta is blurred over an object's outline. Shifted by a
fraction of a patch, the same network sees patches in between. The price is one pass per shift.
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.priors.interfaces import FeatureExtractor
from minislam.records import Frame


class HighResolutionFeatures:
    """Features on a grid `factor` times as fine as that of the extractor inside.

    Each vector still describes a whole patch of the extractor: patches overlap, none is smaller.
    So the finer grid costs factor^2 passes and needs no other training.
    """

    def __init__(self, extractor: FeatureExtractor, factor: int) -> None:
        if factor < 1:
            raise InputError(
                f"expected a grid at least as fine as the extractor's, found a factor of {factor}; "
                "set uncertainty.grid_factor to 1 or 2"
            )
        self.extractor, self.factor = extractor, factor
        self.dimension = extractor.dimension
        self.stride = max(1, round(extractor.stride / factor))

    def __call__(
        self,
        frame: Frame,
    ) -> Tensor:  # (factor * h', factor * w', C)
        """Return the features of a frame on the finer grid."""
        if self.factor == 1:
            return self.extractor(frame)
        # The first vector of each patch is that of its first part, and so on: centres of parts.
        shares = [(part + 0.5) / self.factor - 0.5 for part in range(self.factor)]
        rows = [torch.stack([self._shifted(frame, x, y) for x in shares], 2) for y in shares]
        fine = torch.stack(rows, 1)  # (h', factor, w', factor, C)
        height, _, width, _, channels = fine.shape
        return fine.reshape(height * self.factor, width * self.factor, channels)

    def _shifted(self, frame: Frame, x: float, y: float) -> Tensor:  # (h', w', C)
        """Return the features whose patches lie (x, y) of a patch further right and down."""
        height, width = frame.image.shape[:2]
        rows, columns = height // self.extractor.stride, width // self.extractor.stride
        image = shift_image(frame.image, x * width / columns, y * height / rows)
        return self.extractor(replace(frame, image=image))


def shift_image(
    image: Tensor,  # (H, W, 3)
    right: float,  # px
    down: float,  # px
) -> Tensor:  # (H, W, 3)
    """Return the image whose pixel (u, v) shows (u + right, v + down), the border continued."""
    height, width = image.shape[:2]
    # affine_grid counts in half images.
    turn = image.new_tensor([[1, 0, 2 * right / width], [0, 1, 2 * down / height]])
    batch = image.permute(2, 0, 1)[None]
    where = functional.affine_grid(turn[None], list(batch.shape), align_corners=False)
    shifted = functional.grid_sample(
        batch, where, mode="bilinear", padding_mode="border", align_corners=False
    )
    return shifted[0].permute(1, 2, 0).contiguous()
