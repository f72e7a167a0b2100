"""Features on a finer grid: those of several shifted copies of an image, interleaved.

DINOv2 gives one feature per patch of 14 px, so beta is blurred at the outline of an object. If the
image is shifted by a fraction of a patch, the same network describes the patches in between, at
the cost of one pass of the network per shift (paper supplement).
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from minislam.priors.interfaces import FeatureExtractor
from minislam.records import Frame


def with_finer_grid(extractor: FeatureExtractor, factor: int) -> FeatureExtractor:
    """Return the extractor, on a grid that is `factor` times as fine."""
    return HighResolutionFeatures(extractor, factor) if factor > 1 else extractor


class HighResolutionFeatures:
    """A feature extractor whose grid is `factor` times as fine as that of the extractor inside.

    A feature still describes a whole patch of the extractor; the patches overlap. So the finer
    grid costs factor^2 passes and needs no other training.
    """

    def __init__(self, extractor: FeatureExtractor, factor: int) -> None:
        self.extractor = extractor
        self.factor = factor
        self.dimension = extractor.dimension
        self.stride = max(1, round(extractor.stride / factor))

    def __call__(self, frame: Frame) -> Tensor:  # (factor * h', factor * w', C)
        """Return the features of a frame on the finer grid."""
        # A patch is cut into factor x factor parts; the shifts [patches] lead to their centres.
        shifts = [(part + 0.5) / self.factor - 0.5 for part in range(self.factor)]
        rows = [torch.stack([self._shifted(frame, x, y) for x in shifts], 2) for y in shifts]
        fine = torch.stack(rows, 1)  # (h', factor, w', factor, C)
        height, _, width, _, channels = fine.shape
        return fine.reshape(height * self.factor, width * self.factor, channels)

    def _shifted(self, frame: Frame, x: float, y: float) -> Tensor:  # (h', w', C)
        """Return the features of the patches that lie x patches further right, y further down."""
        height, width = frame.image.shape[:2]
        rows, columns = height // self.extractor.stride, width // self.extractor.stride
        image = shift_image(frame.image, x * width / columns, y * height / rows)
        return self.extractor(replace(frame, pixels=image))


def shift_image(
    image: Tensor,  # (H, W, 3)
    right: float,  # px
    down: float,  # px
) -> Tensor:  # (H, W, 3)
    """Return the image whose pixel (u, v) shows (u + right, v + down); its border is repeated."""
    height, width = image.shape[:2]
    # The unit of affine_grid is half an image.
    motion = image.new_tensor([[1, 0, 2 * right / width], [0, 1, 2 * down / height]])
    batch = image.permute(2, 0, 1)[None]
    grid = functional.affine_grid(motion[None], list(batch.shape), align_corners=False)
    shifted = functional.grid_sample(
        batch, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return shifted[0].permute(1, 2, 0).contiguous()
