"""Dense image features without a network, and any features on a finer grid.

The uncertainty MLP must tell objects apart by their appearance. Statistics of colour and texture
are enough for many scenes, but a grey person before a grey wall takes a pretrained network.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import require
from minislam.priors.interfaces import FeatureExtractor
from minislam.records import Frame

# Centre and spread of each raw feature, of a hundred frames of everyday video, indoor and outdoor.
# Without the centring all colours share one large part, and every cosine would be close to 1.
_LAB_CENTRE = np.array([50.0, 4.0, 10.0], np.float32)  # Lab units of a float image: L is 0..100
_LAB_SPREAD = np.array([23.0, 9.0, 14.0], np.float32)
_CONTRAST_UNIT = np.array([1.0, 0.5, 0.5], np.float32)  # Lab units: contrasts below are noise
_CONTRAST_CENTRE = np.array([1.9, 1.6, 1.9], np.float32)  # of log(1 + standard deviation / unit)
_CONTRAST_SPREAD = np.array([0.9, 0.8, 0.9], np.float32)
_EDGE_UNIT = 0.5  # Lab L per px: gradients below are noise
_EDGE_CENTRE, _EDGE_SPREAD = 1.7, 0.7  # of log(1 + mean gradient / unit)
_ORIENTATION_SPREAD = 0.1  # of the fraction of edges in one orientation bin around 1 / bins

STRIDE = 7  # px, size of a cell: half the patch of DINOv2, since the windows span several cells
WINDOWS = 1, 3, 5  # cells, sides of the square windows whose statistics are taken
ORIENTATION_BINS = 8  # of the edge direction over 180 degrees
# Of contrast and edges relative to colour: colour changes less when the view changes.
TEXTURE_WEIGHT = np.float32(0.5)


class ClassicalFeatures:
    """Colour, contrast and edge orientation on a grid of cells: a `FeatureExtractor`."""

    stride = STRIDE
    dimension = len(WINDOWS) * (3 + 3 + ORIENTATION_BINS + 1)

    def __call__(self, frame: Frame) -> Tensor:  # (H // stride, W // stride, C), of length sqrt(C)
        """Return one vector per cell; the cosine of two is the similarity of their surroundings."""
        image = frame.image
        height, width = (side // STRIDE for side in image.shape[:2])
        lab = cv2.cvtColor(image.detach().cpu().float().numpy(), cv2.COLOR_RGB2LAB)
        channels = [*np.moveaxis(lab, -1, 0), *np.moveaxis(lab * lab, -1, 0)]
        channels += oriented_edges(lab[..., 0])
        cells = [cv2.resize(c, (width, height), interpolation=cv2.INTER_AREA) for c in channels]
        groups = [_describe(np.stack(cells, -1), side) for side in WINDOWS]
        features = torch.from_numpy(np.concatenate(groups, -1))
        # Unit length on average per channel: what an MLP with standard initialisation expects.
        length = features.norm(dim=-1, keepdim=True).clamp_min(1e-6)  # never 0/0
        return (features / length * self.dimension**0.5).to(image.device)


def _describe(
    grid: np.ndarray,  # (h, w, 3 + 3 + bins): Lab, its squares, and edges in Lab L per px
    side: int,  # cells
) -> np.ndarray:  # (h, w, 3 + 3 + bins + 1)
    """Return the centred and scaled statistics of the window of `side` cells."""
    window = cv2.blur(grid, (side, side), borderType=cv2.BORDER_REPLICATE)
    mean, mean_square, edges = np.split(window, (3, 6), -1)
    contrast = np.sqrt(np.maximum(mean_square - mean * mean, 0.0))  # round-off may be < 0
    strength = edges.sum(-1, keepdims=True)
    bins = ORIENTATION_BINS
    # Without edges the orientation is noise, so the fractions then tend to 1 / bins.
    fraction = (edges + _EDGE_UNIT / bins) / (strength + _EDGE_UNIT) - 1 / bins

    color = (mean - _LAB_CENTRE) / _LAB_SPREAD
    texture = [
        (np.log1p(contrast / _CONTRAST_UNIT) - _CONTRAST_CENTRE) / _CONTRAST_SPREAD,
        fraction / _ORIENTATION_SPREAD / np.sqrt(bins / 3, dtype=np.float32),
        (np.log1p(strength / _EDGE_UNIT) - _EDGE_CENTRE) / _EDGE_SPREAD,
    ]
    return np.concatenate([color, *(TEXTURE_WEIGHT * part for part in texture)], -1)


def oriented_edges(brightness: np.ndarray) -> list[np.ndarray]:  # (H, W) float32; one a bin
    """Split the gradient magnitude per px among orientation bins over 180 degrees, linearly."""
    # The 3x3 Sobel kernel sums to 8 per unit slope.
    du = cv2.Sobel(brightness, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(brightness, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    magnitude, angle = cv2.cartToPolar(du, dv)
    bins = ORIENTATION_BINS
    position = (angle * np.float32(bins / np.pi)) % bins  # in bins; opposite directions are one
    distances = (np.abs(position - k) for k in range(bins))
    return [magnitude * np.maximum(1 - np.minimum(d, bins - d), 0) for d in distances]


class HighResolutionFeatures:
    """A feature extractor whose grid is `factor` times as fine as that of the extractor inside.

    DINOv2 gives one feature per patch of 14 px, so beta is blurred at outlines. On images shifted
    by parts of a patch it describes the patches between, in factor^2 passes (paper supplement).
    """

    def __init__(self, extractor: FeatureExtractor, factor: int) -> None:
        self.extractor, self.factor = extractor, factor
        self.dimension = extractor.dimension
        self.stride = max(1, round(extractor.stride / factor))

    def __call__(self, frame: Frame) -> Tensor:  # (factor * h', factor * w', C)
        """Return the features of a frame, finite ones: a NaN would reach the MLP and the map."""
        features = self.extractor(frame) if self.factor == 1 else self._between(frame)
        wanted = f"finite features of frame {frame.frame_index}"
        advice = "give --precision fp32, or other --features"
        require(bool(features.isfinite().all()), wanted, f"NaN or infinity; {advice}")
        return features

    def _between(self, frame: Frame) -> Tensor:
        """Return the features of all patches and of those between them."""
        stride = self.extractor.stride
        patch_height, patch_width = (side / (side // stride) for side in frame.image.shape[:2])
        # A patch is cut into factor x factor parts; the shifts [patches] lead to their centres.
        shifts = [(part + 0.5) / self.factor - 0.5 for part in range(self.factor)]

        def features_at(x: float, y: float) -> Tensor:  # (h', w', C) of patches further right, down
            image = shift_image(frame.image, x * patch_width, y * patch_height)
            return self.extractor(replace(frame, pixels=image))

        rows = [torch.stack([features_at(x, y) for x in shifts], 2) for y in shifts]
        return torch.stack(rows, 1).flatten(2, 3).flatten(0, 1)  # of (h', factor, w', factor, C)


def shift_image(image: Tensor, right: float, down: float) -> Tensor:  # (H, W, 3), px
    """Return the image whose pixel (u, v) shows (u + right, v + down); its border is repeated."""
    height, width = image.shape[:2]
    # The unit of affine_grid is half an image.
    motion = image.new_tensor([[1, 0, 2 * right / width], [0, 1, 2 * down / height]])
    batch = image.permute(2, 0, 1)[None]
    grid = functional.affine_grid(motion[None], list(batch.shape), align_corners=False)
    shifted = functional.grid_sample(batch, grid, padding_mode="border", align_corners=False)
    return shifted[0].permute(1, 2, 0).contiguous()
