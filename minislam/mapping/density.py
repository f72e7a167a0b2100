"""Clone, split and prune Gaussians: put them where the images ask for detail."""

from dataclasses import fields

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.geometry.se3 import rotation_from_quaternion
from minislam.mapping.config import DensityConfig
from minislam.splatting import GaussianMap, MapOptimizer
from minislam.state.stateful import Stateful

_CHILDREN = 2  # of a Gaussian that is split, 3DGS


class ScreenGradients(Stateful):
    """Mean length of dL/d(projected mean) of each Gaussian over the views that saw it.

    In half images instead of pixels, so that the threshold holds for every image size.
    """

    total: Tensor  # (N,) sum of the lengths
    views: Tensor  # (N,) number of views

    def __init__(self, count: int) -> None:
        self.total = torch.zeros(count)
        self.views = torch.zeros(count)

    def add(
        self,
        v_screen: Tensor,  # (N, 2) dL/d(pixel)
        radii: Tensor,  # (N,) px, 0 where not seen
        camera: Camera,
    ) -> None:
        """Count one view."""
        self.total = self.total.to(v_screen)
        self.views = self.views.to(v_screen)
        half_image = v_screen.new_tensor([camera.width / 2, camera.height / 2])
        seen = radii > 0
        self.total += torch.where(seen, (v_screen * half_image).norm(dim=-1), 0)
        self.views += seen

    @property
    def mean(self) -> Tensor:
        """Return the means (N,); 0 for what no view saw."""
        return self.total / self.views.clamp_min(1)


def densify(
    optimizer: MapOptimizer,
    gradients: Tensor,  # (N,) mean screen gradient
    median_depth: float,  # world units, of the scene
    config: DensityConfig,
    generator: torch.Generator,
) -> int:
    """Clone small and split large Gaussians of large screen gradient; return the rows added.

    A clone starts at its original and the gradients pull the two apart. Two children of a split
    are drawn from the parent, which disappears. Children keep their parent's anchor.
    """
    gaussians = optimizer.gaussians.detach()
    room = config.max_gaussians - len(gaussians)
    if room <= 0:
        return 0
    chosen = gradients > config.gradient
    if int(chosen.sum()) > room:
        # The strongest gradients first when there is not room for all.
        chosen &= gradients >= gradients.topk(room).values[-1]
    large = gaussians.scales.max(-1).values > config.split_scale * median_depth
    clones = gaussians.prune(chosen & ~large)
    parents = gaussians.prune(chosen & large)
    children = split(parents, config.split_shrink, generator)
    optimizer.append(clones.concatenate(children))
    added = torch.ones(len(clones) + len(children), dtype=torch.bool, device=chosen.device)
    optimizer.prune(torch.cat([~(chosen & large), added]))
    return len(clones) + len(children) - len(parents)


def split(parents: GaussianMap, shrink: float, generator: torch.Generator) -> GaussianMap:
    """Return two children per parent, drawn from its distribution and `shrink` times smaller."""
    rows = [getattr(parents, f.name).repeat_interleave(_CHILDREN, 0) for f in fields(parents)]
    doubled = GaussianMap(*rows)
    normal = torch.randn(doubled.means.shape, generator=generator).to(doubled.means)
    rotations = rotation_from_quaternion(doubled.quats_wxyz)
    offsets = (rotations @ (doubled.scales * normal)[..., None]).squeeze(-1)
    return GaussianMap(
        doubled.means + offsets,
        doubled.quats_wxyz,
        doubled.log_scales - torch.tensor(shrink).log().to(doubled.means),
        doubled.opacity_logits,
        doubled.colors,
        doubled.anchor_keyframe,
    )


def useful_rows(
    gaussians: GaussianMap,
    median_depth: float,  # world units, of the scene
    config: DensityConfig,
) -> Tensor:  # (N,) bool
    """Tell which Gaussians stay: those neither faint nor huge, and finite."""
    opaque = gaussians.opacities > config.prune_opacity
    small = gaussians.scales.max(-1).values < config.prune_scale * median_depth
    # One bad number would spread over every pixel that the Gaussian touches.
    finite = gaussians.means.isfinite().all(-1)
    return (opaque & small & finite).detach()
