"""LPIPS with made-up weights: against a plain re-computation, and what any distance obeys."""

from functools import cache

import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.evaluation.lpips import Lpips, recognise_heads, recognise_trunk
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

SHAPES = {
    "alex": ({0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3),
              10: (256, 256, 3)}, (64, 192, 384, 256, 256)),
    "vgg": ({0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3),
             12: (256, 256, 3), 14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3),
             21: (512, 512, 3), 24: (512, 512, 3), 26: (512, 512, 3), 28: (512, 512, 3)},
            (64, 128, 256, 512, 512)),
}  # fmt: skip


@cache
def trunk(name: str) -> dict[str, torch.Tensor]:
    """Return a trunk under torchvision's names, with a classifier that LPIPS has no use for."""
    shapes = {"classifier.6.bias": [1000]}
    for number, (out, into, side) in SHAPES[name][0].items():
        shapes[f"features.{number}.weight"] = [out, into, side, side]
        shapes[f"features.{number}.bias"] = [out]
    return rebuilt.tensors_of(shapes)


@cache
def heads(name: str) -> dict[str, torch.Tensor]:
    shapes = {f"lin{k}.model.1.weight": [1, c, 1, 1] for k, c in enumerate(SHAPES[name][1])}
    return {n: t.abs() for n, t in rebuilt.tensors_of(shapes).items()}


@cache
def metric(name: str) -> Lpips:
    return Lpips(trunk(name), heads(name))


def plain_modules(name: str) -> list[torch.nn.Sequential]:
    """Return the five groups of layers as torch's own modules, written down once more."""
    nn, relu, t = torch.nn, torch.nn.ReLU, SHAPES[name][0]
    if name == "alex":
        groups = [[0], ["pool", 3], ["pool", 6], [8], [10]]
        pool = nn.MaxPool2d(3, 2)
        size = {0: (11, 4, 2), 3: (5, 1, 2)}
    else:
        groups = [[0, 2], ["pool", 5, 7], ["pool", 10, 12, 14], ["pool", 17, 19, 21],
                  ["pool", 24, 26, 28]]  # fmt: skip
        pool, size = nn.MaxPool2d(2, 2), {}
    modules = []
    for group in groups:
        layers = []
        for item in group:
            if item == "pool":
                layers.append(pool)
                continue
            layer = nn.Conv2d(t[item][1], t[item][0], *size.get(item, (3, 1, 1)))
            layer.weight.data = trunk(name)[f"features.{item}.weight"]
            layer.bias.data = trunk(name)[f"features.{item}.bias"]
            layers += [layer, relu()]
        modules.append(nn.Sequential(*layers))
    return modules


def plain_distance(name: str, a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the distance as the definition says, pixel by pixel in numpy and float64."""
    total = 0.0
    maps = []
    for image in (a, b):
        x = image.permute(2, 0, 1)[None]
        shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        x = (x * 2 - 1 - shift) / torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
        levels = []
        for module in plain_modules(name):
            x = module(x)
            levels.append(x[0].detach().double().numpy())
        maps.append(levels)
    for level, (fa, fb) in enumerate(zip(*maps, strict=True)):
        w = heads(name)[f"lin{level}.model.1.weight"].double().numpy().ravel()
        values = []
        for row in range(fa.shape[1]):
            for column in range(fa.shape[2]):
                va, vb = fa[:, row, column], fb[:, row, column]
                va, vb = va / (np.linalg.norm(va) + 1e-10), vb / (np.linalg.norm(vb) + 1e-10)
                values.append(float(w @ (va - vb) ** 2))
        total += float(np.mean(values))
    return total


# Known answers


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_the_distance_is_what_a_plain_recomputation_gives(name: str):
    image = rebuilt.image(33, 47)
    expected = plain_distance(name, image, image.flip(1))
    assert expected > 0.01
    assert metric(name)(image, image.flip(1)) == pytest.approx(expected, rel=2e-5)


def test_the_layout_follows_from_the_shapes():
    assert recognise_trunk(trunk("alex")).name == recognise_heads(heads("alex")) == "AlexNet"
    assert recognise_trunk(trunk("vgg")).name == recognise_heads(heads("vgg")) == "VGG-16"


# Identities


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_equal_images_have_no_distance_and_order_does_not_matter(name: str):
    a, b = rebuilt.image(40, 48), rebuilt.image(40, 48).flip(0)
    assert metric(name)(a, a) == 0.0
    assert metric(name)(a, b) == pytest.approx(metric(name)(b, a), rel=1e-6)
    assert metric(name)(a, b) > 0


def test_more_blur_is_further_away():
    sharp = rebuilt.image(64, 64)
    grown = [
        torch.nn.functional.avg_pool2d(sharp.permute(2, 0, 1), k, 1, k // 2).permute(1, 2, 0)
        for k in (3, 5, 7)
    ]
    distances = [metric("alex")(blurred, sharp) for blurred in grown]
    assert 0 < distances[0] < distances[1] < distances[2]


def test_what_a_picture_cannot_show_is_clipped():
    image = rebuilt.image(32, 32)
    assert metric("alex")(2 * image - 0.5, (2 * image - 0.5).clamp(0, 1)) == 0.0


# Errors


def test_small_and_unlike_images_are_refused():
    with pytest.raises(InputError, match=r"at least 31x31 px for LPIPS with AlexNet, found 40x30"):
        metric("alex")(rebuilt.image(30, 40), rebuilt.image(30, 40))
    assert metric("alex")(rebuilt.image(31, 31), rebuilt.image(31, 31).flip(0)) > 0
    assert metric("vgg")(rebuilt.image(16, 16), rebuilt.image(16, 16).flip(0)) > 0
    with pytest.raises(InputError, match=r"at least 16x16 px for LPIPS with VGG-16"):
        metric("vgg")(rebuilt.image(15, 40), rebuilt.image(15, 40))
    with pytest.raises(AssertionError):
        metric("alex")(rebuilt.image(32, 40), rebuilt.image(40, 32))
    with pytest.raises(InputError, match=r"images of floats in \[0, 1\], found uint8; divide"):
        metric("alex")(rebuilt.image(32, 32), torch.full((32, 32, 3), 100, dtype=torch.uint8))


def test_files_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="heads for AlexNet, found heads for VGG-16"):
        Lpips(trunk("alex"), heads("vgg"))
    short = {n: t for n, t in trunk("vgg").items() if n != "features.28.bias"}
    with pytest.raises(InputError, match=r"features\.28\.bias of VGG-16 .* found none"):
        Lpips(short, heads("vgg"))
    with pytest.raises(InputError, match="AlexNet or VGG-16 for LPIPS, found another network"):
        Lpips(heads("alex"), heads("alex"))
    with pytest.raises(InputError, match="five LPIPS heads"):
        Lpips(trunk("alex"), trunk("alex"))
