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

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError

# Mean and spread of natural images, for values in [-1, 1]: RGB, from the authors' code.
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_SMALLEST_LENGTH = 1e-10  # added to the length of a feature vector: where nothing fires it is 0


@dataclass(frozen=True)
class _Stage:
    """Some convolutions, each followed by a ReLU; the output of the last one is compared."""

    convs: tuple[int, ...]  # number in the names: features.{number}.weight
    channels: int  # of the output
    pool: int = 0  # size of a maximum filter of stride 2 before the first convolution, 0: none


@dataclass(frozen=True)
class _Trunk:
    """The convolutions of one classifier, up to the last that is compared."""

    name: str
    first_kernel: int  # px, of features.0
    first_stride: int  # px
    smallest_side: int  # px of an image whose coarsest map has one cell
    stages: tuple[_Stage, ...]


_ALEXNET = _Trunk(
    "AlexNet", 11, 4, 31,
    (
        _Stage((0,), 64), _Stage((3,), 192, pool=3), _Stage((6,), 384, pool=3),
        _Stage((8,), 256), _Stage((10,), 256),
    ),
)  # fmt: skip
_VGG16 = _Trunk(
    "VGG-16", 3, 1, 16,
    (
        _Stage((0, 2), 64), _Stage((5, 7), 128, pool=2), _Stage((10, 12, 14), 256, pool=2),
        _Stage((17, 19, 21), 512, pool=2), _Stage((24, 26, 28), 512, pool=2),
    ),
)  # fmt: skip


class Lpips:
    """Measures the distance between images."""

    def __init__(
        self,
        trunk: Mapping[str, Tensor],  # torchvision's names: features.0.weight, ...
        heads: Mapping[str, Tensor],  # the authors' names: lin0.model.1.weight, ...
    ) -> None:
        self._layout = recognise_trunk(trunk)
        found = recognise_heads(heads)
        if found != self._layout.name:
            raise InputError(
                f"expected LPIPS heads for {self._layout.name}, found heads for {found}; give "
                "alex.pth with AlexNet and vgg.pth with VGG-16"
            )
        self.name = found
        self._trunk, self._heads = trunk, heads

    def __call__(
        self,
        image: ArrayLike,  # (H, W, 3) RGB in [0, 1]
        reference: ArrayLike,  # the same shape
    ) -> float:
        """Return the distance of two images, 0 for equal ones."""
        both = [torch.from_numpy(np.asarray(x, np.float32)).clamp(0, 1) for x in (image, reference)]
        with torch.no_grad():
            return float(self.distance(*both))

    def require_size(self, width: int, height: int) -> None:
        """Refuse images that are too small to compare [px]."""
        side = self._layout.smallest_side
        if min(width, height) < side:
            raise InputError(
                f"expected images of at least {side}x{side} px for LPIPS with {self.name}, found "
                f"{width}x{height}; give a larger working size"
            )

    def distance(self, image: Tensor, reference: Tensor) -> Tensor:
        """Return the distance of two images (H, W, 3), differentiable."""
        if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3:
            raise InputError(
                f"expected two RGB images of one size, found {tuple(image.shape)} and "
                f"{tuple(reference.shape)}; render at the size of the reference"
            )
        self.require_size(image.shape[1], image.shape[0])
        total = image.new_zeros(())
        pairs = zip(self._features(image), self._features(reference), strict=True)
        for level, (a, b) in enumerate(pairs):
            weight = self._heads[f"lin{level}.model.1.weight"].to(image).reshape(-1, 1, 1)
            total = total + (weight * (a - b) ** 2).sum(0).mean()
        return total

    def _features(self, image: Tensor) -> list[Tensor]:  # five of (C, h, w), of unit length
        scaled = (2 * image - 1 - image.new_tensor(_SHIFT)) / image.new_tensor(_SCALE)
        x, levels = scaled.permute(2, 0, 1)[None], []
        for stage in self._layout.stages:
            if stage.pool:
                x = functional.max_pool2d(x, stage.pool, stride=2)
            for number in stage.convs:
                x = self._conv(x, number).relu()
            length = x.square().sum(1, keepdim=True).sqrt()
            levels.append((x / (length + _SMALLEST_LENGTH))[0])
        return levels

    def _conv(self, x: Tensor, number: int) -> Tensor:
        weight, bias = (
            self._trunk[f"features.{number}.{part}"].to(x) for part in ("weight", "bias")
        )
        stride = self._layout.first_stride if number == 0 else 1
        # AlexNet's first kernel of 11 px has a border of 2 px, all others keep the size.
        padding = 2 if weight.shape[-1] == _ALEXNET.first_kernel else weight.shape[-1] // 2
        return functional.conv2d(x, weight, bias, stride, padding)


def recognise_trunk(trunk: Mapping[str, Tensor]) -> _Trunk:
    """Return the layout of a trunk that is complete, by the shapes of its convolutions."""
    first = trunk["features.0.weight"] if "features.0.weight" in trunk else None
    for layout in (_ALEXNET, _VGG16):
        if first is None or first.shape[-1] != layout.first_kernel:
            continue
        for name, shape in _expected_channels(layout).items():
            found = tuple(trunk[name].shape[:2]) if name in trunk else "none"
            if found != shape:
                raise InputError(
                    f"expected {name} of {layout.name} to have {shape} channels, found "
                    f"{found}; give torchvision's file of this network, whole"
                )
        return layout
    raise InputError(
        "expected the convolutions of AlexNet or VGG-16 for LPIPS, found another network; give "
        "alexnet-owt-*.pth or vgg16-*.pth of torchvision"
    )


def _expected_channels(layout: _Trunk) -> dict[str, tuple[int, ...]]:
    """Return the channels (out, in) of every weight and (out,) of every bias of a trunk."""
    expected: dict[str, tuple[int, ...]] = {}
    channels = 3
    for stage in layout.stages:
        for number in stage.convs:
            expected[f"features.{number}.weight"] = (stage.channels, channels)
            expected[f"features.{number}.bias"] = (stage.channels,)
            channels = stage.channels
    return expected


def recognise_heads(heads: Mapping[str, Tensor]) -> str:
    """Return the name of the trunk that heads belong to, by their channels."""
    names = [f"lin{level}.model.1.weight" for level in range(len(_ALEXNET.stages))]
    found = [tuple(heads[name].shape) if name in heads else None for name in names]
    for layout in (_ALEXNET, _VGG16):
        if found == [(1, stage.channels, 1, 1) for stage in layout.stages]:
            return layout.name
    raise InputError(
        f"expected five LPIPS heads lin0 to lin4 for AlexNet or VGG-16, found shapes {found}; give "
        "alex.pth or vgg.pth of the authors' weights/v0.1"
    )
