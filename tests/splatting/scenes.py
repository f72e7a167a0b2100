"""Random maps and cameras for the splatting tests, in float64, ordinary and hostile."""

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp
from minislam.splatting import GaussianMap
from tests.helpers import generator

KINDS = ("ordinary", "off_screen", "behind", "huge", "needles", "capped", "faint", "crowded")


def random_map(kind: str, count: int, seed: int) -> GaussianMap:
    """Return a map of `count` Gaussians in front of the origin, of the kind that is named."""
    source = generator(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=source, dtype=torch.float64)

    means = normal(count, 3) * torch.tensor([0.6, 0.5, 0.4]) + torch.tensor([0.0, 0.0, 2.5])
    log_scales = 0.4 * normal(count, 3) - 2.0
    logits = 1.5 * normal(count)
    if kind == "off_screen":
        means[:, :2] *= 6
    elif kind == "behind":
        means[:, 2] -= 2.5  # half are behind the camera, some close to the near plane
    elif kind == "huge":
        log_scales += 2.5
    elif kind == "needles":
        log_scales += torch.tensor([1.5, -3.0, -3.0])
    elif kind == "capped":
        logits += 6  # above the largest opacity of 0.99
    elif kind == "faint":
        logits -= 5.5  # around the opacity of 1/255, below which nothing is drawn
    elif kind == "crowded":
        means[:, :2] *= 0.2  # more than one chunk of slots per tile
    colors = torch.rand(count, 3, generator=source, dtype=torch.float64)
    anchors = torch.arange(count)
    return GaussianMap(means, normal(count, 4), log_scales, logits, colors, anchors)


def converted(gaussians: GaussianMap, dtype: torch.dtype) -> GaussianMap:
    """Return a copy of a map with all parameters in another floating-point type."""
    parameters = [values.to(dtype, copy=True) for values in gaussians.parameters.values()]
    return GaussianMap(*parameters, gaussians.anchor_keyframe)


def random_camera(seed: int) -> Camera:
    """Return a small camera: any size, unequal focal lengths, principal point off the centre."""
    source = generator(seed)
    width, height = (int(n) for n in torch.randint(5, 36, (2,), generator=source))
    fx, fy, cx, cy = torch.rand(4, generator=source, dtype=torch.float64).tolist()
    focal = 0.8 * max(width, height)
    return Camera(
        focal * (0.7 + fx), focal * (0.7 + fy), width * (0.2 + 0.6 * cx), height * (0.2 + 0.6 * cy),
        width, height,
    )  # fmt: skip


def random_pose(seed: int) -> Tensor:
    """Return a T_camera_world (4, 4) a few centimetres and degrees from the identity."""
    return se3_exp(0.1 * torch.randn(6, generator=generator(seed), dtype=torch.float64))


def one_gaussian(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    scale: float = 0.2,
    opacity: float = 0.8,
    color: tuple[float, float, float] = (0.9, 0.5, 0.1),
) -> GaussianMap:
    """Return a map of a single round Gaussian."""
    return GaussianMap(
        torch.tensor([mean], dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        torch.full((1, 3), scale, dtype=torch.float64).log(),
        torch.tensor([opacity], dtype=torch.float64).logit(),
        torch.tensor([color], dtype=torch.float64),
        torch.zeros(1, dtype=torch.int64),
    )
