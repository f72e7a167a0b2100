"""Clone, split and prune Gaussians, so that there are more of them where detail is missing."""

from dataclasses import replace

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_inverse
from minislam.geometry.se3 import rotation_from_quaternion
from minislam.mapping.config import DensityConfig
from minislam.splatting import GaussianMap, MapOptimizer

CHILDREN = 2  # of a Gaussian that is split, 3DGS
SPLIT_SCALE = 0.02  # median depths: larger ones are split, smaller ones cloned; official 0.06 m
SPLIT_SHRINK = 1.6  # scale of a parent over that of its children, 3DGS
PRUNE_OPACITY = 0.1  # fainter ones are removed; official 0.005 at first and 0.7 online
PRUNE_SCALE = 0.2  # of median depth or own distance, the larger: beyond, removed; official 0.6 m


def screen_gradients(
    v_screen: Tensor,  # (N, 2) dL/d(pixel)
    weight_sums: Tensor,  # (N,) px, as of a `Rendering`: 0 where not seen
    camera: Camera,
) -> Tensor:  # (2, N)
    """Return the length of dL/d(projected mean) in a view, 0 where not seen, and 1 where seen."""
    # The unit of length is half an image, so that one threshold holds for every image size.
    half_image = v_screen.new_tensor([camera.width / 2, camera.height / 2])
    seen = (weight_sums > 0).to(v_screen)
    return torch.stack([seen * (v_screen * half_image).norm(dim=-1), seen])


def densify(
    optimizer: MapOptimizer,
    gradients: Tensor,  # (2, N) screen gradients summed over views
    median_depth: float,  # world units, of the scene
    config: DensityConfig,
    generator: torch.Generator,
) -> None:
    """Clone small and split large Gaussians of large screen gradient.

    A clone starts as a copy, and later gradients move the two apart. A split replaces the parent
    by two children at random places inside it. Both keep the anchor keyframe.
    """
    gaussians = optimizer.gaussians.detach()
    capacity = config.max_gaussians - len(gaussians)
    if capacity <= 0:
        return
    lengths, views = gradients
    means = lengths / views.clamp_min(1)
    chosen = means > config.gradient
    if int(chosen.sum()) > capacity:  # take those of the largest gradients
        chosen &= means >= means.topk(capacity).values[-1]
    large = gaussians.scales.max(-1).values > SPLIT_SCALE * median_depth
    clones = gaussians.keep(chosen & ~large)
    children = split(gaussians.keep(chosen & large), generator)
    optimizer.keep(~(chosen & large))
    optimizer.append(clones.concatenate(children))


def split(parents: GaussianMap, generator: torch.Generator) -> GaussianMap:
    """Return two children per parent, drawn from its distribution and 1.6 times smaller."""
    doubled = GaussianMap(*(t.repeat_interleave(CHILDREN, 0) for t in vars(parents).values()))
    normal = torch.randn(doubled.means.shape, generator=generator).to(doubled.means)
    rotations = rotation_from_quaternion(doubled.quats_wxyz)
    offsets = (rotations @ (doubled.scales * normal)[..., None]).squeeze(-1)
    log_scales = doubled.log_scales - doubled.means.new_tensor(SPLIT_SHRINK).log()
    return replace(doubled, means=doubled.means + offsets, log_scales=log_scales)


def useful_rows(
    gaussians: GaussianMap,
    T_camera_world: Tensor,  # (K, 4, 4) of the images that they are anchored to
    median_depth: float,  # world units, of the scene
) -> Tensor:  # (N,) bool
    """Tell which Gaussians stay: finite, not faint, not huge beside scene and distance."""
    centres = se3_inverse(T_camera_world)[gaussians.anchor_keyframe, :3, 3]
    distances = (gaussians.means - centres.to(gaussians.means)).norm(dim=-1)
    opaque = gaussians.opacities > PRUNE_OPACITY
    small = gaussians.scales.max(-1).values < PRUNE_SCALE * distances.clamp_min(median_depth)
    # One bad number would spread to all pixels of the tiles that list the Gaussian.
    numbers = gaussians.means, gaussians.quats_wxyz, gaussians.colors
    finite = torch.cat(numbers, 1).isfinite().all(-1)
    return (opaque & small & finite).detach()
