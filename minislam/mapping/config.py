"""The settings of mapping. "official" names the constants of the authors' code."""

import math
from dataclasses import dataclass, field

from minislam.parameters import parameter
from minislam.splatting import LearningRates


@dataclass(frozen=True)
class InsertionConfig:
    """How densely an image adds Gaussians, and how they start."""

    cell: int = parameter(2, "one Gaussian per cell of this side [px of the full image]", 1, 1000)
    plain: float = parameter(
        0.12, "largest range of each colour in a cell of 2 or 4 times the side; 0, official: none"
    )
    footprint: float = parameter(0.45, "first scale over the side of its cell; official 0.22", 0.01)
    opacity: float = parameter(0.9, "first opacity; official 0.5", 0.01, 0.99)


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are cloned, split and removed."""

    interval: int = parameter(100, "iterations between two rounds, official in initialisation", 1)
    gradient: float = parameter(
        2e-4, "mean screen gradient that clones or splits a Gaussian, official [1 per half image]"
    )
    max_gaussians: int = parameter(
        0, "size of the map above which none is cloned or split; 0: never any, official: always"
    )


@dataclass(frozen=True)
class PoseRefinementConfig:
    """How the poses between the keyframes are refined by re-rendering, at full image size."""

    enabled: bool = parameter(False, "off: those poses come from flow alone (paper's fast mode)")
    iterations: int = parameter(10, "most steps of a frame; official 100, ours divide by curvature")
    tolerance: float = parameter(
        0.01, "stop when a step moves the picture by less [px]; official |step| < 1e-4"
    )


@dataclass(frozen=True)
class MappingConfig:
    """Iterations, window, losses and step lengths.

    The world has no fixed unit, so lengths are given in median depths of the images that a map is
    begun with: online the first keyframes, at the end all.
    """

    image_scale: float = parameter(
        0.5, "size of the images, of the full one, until the last part of the refinement", 0.01, 1
    )
    views_per_step: int = parameter(
        2, "images rendered per step, each an iteration; --workers share them; paper 1", 1
    )
    init_iterations: int = parameter(
        150,
        "iterations on the images that a map begins with: at least 4 of each if beta is learned, "
        "online at most keyframe_iterations of each; official 1050",
    )
    keyframe_iterations: int = parameter(12, "iterations per keyframe, online; official 450")
    keyframe_stride: int = parameter(1, "optimise at every n-th keyframe only; fast mode 5", 1)
    refine_iterations: int = parameter(400, "iterations at the end; official 20000, fast 3000")
    refine_images: int = parameter(
        100, "images for which refine_iterations are enough; more get more in proportion, 0: never"
    )
    refine_full_fraction: float = parameter(
        0.4, "last fraction of the refinement at full image size [0, 1]; official 1", most=1
    )
    freeze_iterations: int = parameter(
        5, "iterations without MLP training after a change of density; official 20, at the end 200"
    )

    window_size: int = parameter(10, "most keyframes in the local window, official", 3)
    window_probability: float = parameter(
        0.5, "probability that an iteration takes a keyframe of the window, Sec. 3.4", most=1
    )

    color_weight: float = parameter(
        0.8, "alpha: lambda_5 = alpha / 2, lambda_6 = (1 - alpha) / 2; official 0.5 or 0.8", most=1
    )
    lambda_ssim: float = parameter(0.2, "weight of SSIM in L_color, Eq. (7), official", most=1)
    lambda_isotropic: float = parameter(10.0, "lambda_7: weight of L_iso [1 per m], official")
    mean_background: bool = parameter(
        True, "what no image shows has the mean colour of those it begins with; off: official black"
    )

    means_rate: float = parameter(
        2e-3, "first step of means [median depths]; official 9.6e-4 m", most=1
    )
    means_rate_end: float = parameter(
        0.1, "last step of the means over the first, log-linear; official 0.01", most=1
    )
    rate_iterations: int = parameter(1500, "iterations of means_rate's decay; official 30000", 1)
    quats_rate: float = parameter(2e-2, "Adam step of the quaternions; official 1e-3", most=1)
    log_scales_rate: float = parameter(2e-2, "Adam step of the log-scales; official 6e-3", most=1)
    opacity_rate: float = parameter(5e-2, "Adam step of the opacity logits, official", most=1)
    colors_rate: float = parameter(5e-3, "Adam step of the colours; official 7.05e-4", most=1)
    refine_rate_end: float = parameter(
        0.2, "last step over the first in refinement; official 1", most=1
    )

    insertion: InsertionConfig = field(default_factory=InsertionConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    pose_refinement: PoseRefinementConfig = field(default_factory=PoseRefinementConfig)

    def refinement(self, images: float) -> int:
        """Return the iterations at the end, for a map of so many images."""
        times = images / self.refine_images if self.refine_images else 0.0
        return math.ceil(self.refine_iterations * max(1.0, times))

    def rates_at(self, iteration: int, median_depth: float, factor: float) -> LearningRates:
        """Return the steps of an iteration, times `factor`; those of means [world units] decay."""
        decay = self.means_rate_end ** min(1.0, iteration / self.rate_iterations)
        return LearningRates(
            means=factor * decay * self.means_rate * median_depth,
            quats_wxyz=factor * self.quats_rate,
            log_scales=factor * self.log_scales_rate,
            opacity_logits=factor * self.opacity_rate,
            colors=factor * self.colors_rate,
        )
