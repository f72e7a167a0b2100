"""LPIPS, a learned distance of two images (Zhang et al. 2018): smaller means more similar.

Both images go through a classifier's convolutions (the "trunk", AlexNet or VGG-16). At five depths
their feature vectors are compared pixel by pixel. Trained weights (the "heads") say how much the
difference in each channel matters to a human eye:

    distance = sum over depths l of  mean over pixels of  sum_c w_lc (f_lc(a) - f_lc(b))^2

with every feature vector f scaled to unit length. The user gives the files: the trunk from
torchvision, the heads from the authors' repository (weights/v0.1). SLAM papers use AlexNet.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError, require
from minislam.evaluation.images import checked_images

# Mean and spread of natural images, for values in [-1, 1]: RGB, from the authors' code.
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_SMALLEST_LENGTH = 1e-10  # added to the length of a feature vector: where nothing fires it is 0


@dataclass(frozen=True)
class _Trunk:
    """The convolutions of a classifier, with ReLU, in five stages; the last of each is compared."""

    name: str
    convs: tuple[tuple[int, ...], ...]  # numbers in the names: features.{number}.weight
    channels: tuple[int, ...]  # of the output of each stage
    pooled: int  # stages 1 to this one begin with max pooling, of stride 2
    pool: int  # px, side of its window
    first_kernel: int  # px, of features.0
    first_stride: int  # px
    smallest_side: int  # px of an image whose coarsest map has one cell


_ALEXNET_CONVS = (0,), (3,), (6,), (8,), (10,)
_ALEXNET = _Trunk("AlexNet", _ALEXNET_CONVS, (64, 192, 384, 256, 256), 2, 3, 11, 4, 31)
_VGG_CONVS = (0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)
_VGG16 = _Trunk("VGG-16", _VGG_CONVS, (64, 128, 256, 512, 512), 4, 2, 3, 1, 16)


class Lpips:
    """Measures the distance between images."""

    def __init__(self, trunk: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> None:
        """Take torchvision's features.0.weight, ..., and the authors' lin0.model.1.weight, ..."""
        self._layout, self.name = recognise_trunk(trunk), recognise_heads(heads)
        found = f"heads for {self.name}; give alex.pth with AlexNet and vgg.pth with VGG-16"
        fits = self.name == self._layout.name
        require(fits, f"LPIPS heads for {self._layout.name}", found)
        self._trunk, self._heads = trunk, heads

    def __call__(self, image: ArrayLike, reference: ArrayLike) -> float:
        """Return the distance of two images (H, W, 3) RGB in [0, 1], 0 for equal ones."""
        both = [torch.from_numpy(x).float() for x in checked_images(image, reference)]
        height, width, channels = both[0].shape
        assert channels == 3, both[0].shape
        self.require_size(width, height)
        total = 0.0
        with torch.no_grad():
            for level, (a, b) in enumerate(zip(*map(self._features, both), strict=True)):
                weight = self._heads[f"lin{level}.model.1.weight"].reshape(-1, 1, 1)
                total += float((weight * (a - b) ** 2).sum(0).mean())
        return total

    def require_size(self, width: int, height: int) -> None:
        """Refuse images that are too small to compare [px]."""
        side = self._layout.smallest_side
        wanted = f"images of at least {side}x{side} px for LPIPS with {self.name}"
        found = f"{width}x{height}; give a larger working size"
        require(min(width, height) >= side, wanted, found)

    def _features(self, image: Tensor) -> list[Tensor]:  # five of (C, h, w), of unit length
        scaled = (2 * image - 1 - image.new_tensor(_SHIFT)) / image.new_tensor(_SCALE)
        x, levels = scaled.permute(2, 0, 1)[None], []
        for stage, convs in enumerate(self._layout.convs):
            if 0 < stage <= self._layout.pooled:
                x = functional.max_pool2d(x, self._layout.pool, stride=2)
            for number in convs:
                name = f"features.{number}"
                weight, bias = self._trunk[f"{name}.weight"], self._trunk[f"{name}.bias"]
                stride = self._layout.first_stride if number == 0 else 1
                # AlexNet's first kernel of 11 px has a border of 2 px, all others keep the size.
                side = weight.shape[-1]
                padding = 2 if side == _ALEXNET.first_kernel else side // 2
                x = functional.conv2d(x, weight, bias, stride, padding).relu()
            length = x.square().sum(1, keepdim=True).sqrt()
            levels.append((x / (length + _SMALLEST_LENGTH))[0])
        return levels


def recognise_trunk(trunk: Mapping[str, Tensor]) -> _Trunk:
    """Return the layout of a trunk that is complete, by the shapes of its convolutions."""
    kernel = trunk["features.0.weight"].shape[-1] if "features.0.weight" in trunk else 0
    layout = {known.first_kernel: known for known in (_ALEXNET, _VGG16)}.get(kernel)
    if layout is None:
        advice = "give alexnet-owt-*.pth or vgg16-*.pth of torchvision"
        wanted = "the convolutions of AlexNet or VGG-16 for LPIPS"
        raise InputError(f"expected {wanted}, found another network; {advice}")
    before = 3
    for channels, convs in zip(layout.channels, layout.convs, strict=True):
        for number in convs:
            for part, shape in (("weight", (channels, before)), ("bias", (channels,))):
                name = f"features.{number}.{part}"
                found = tuple(trunk[name].shape[:2]) if name in trunk else "none"
                wanted = f"{name} of {layout.name} to have {shape} channels"
                advice = "give torchvision's file of this network, whole"
                require(found == shape, wanted, f"{found}; {advice}")
            before = channels
    return layout


def recognise_heads(heads: Mapping[str, Tensor]) -> str:
    """Return the name of the trunk that heads belong to, by their channels."""
    names = [f"lin{level}.model.1.weight" for level in range(len(_ALEXNET.convs))]
    found = [tuple(heads[name].shape) if name in heads else None for name in names]
    for layout in (_ALEXNET, _VGG16):
        if found == [(1, channels, 1, 1) for channels in layout.channels]:
            return layout.name
    advice = "give alex.pth or vgg.pth of the authors' weights/v0.1"
    wanted = "five LPIPS heads lin0 to lin4 for AlexNet or VGG-16"
    raise InputError(f"expected {wanted}, found shapes {found}; {advice}")
