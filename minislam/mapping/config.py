"""The constants of mapping."""

from dataclasses import dataclass, field

from minislam.errors import InputError
from minislam.parameters import parameter
from minislam.splatting import LearningRates


@dataclass(frozen=True)
class InsertionConfig:
    """Where a keyframe adds Gaussians, and how large they start."""

    cell: int = parameter(3, "one Gaussian per cell of this side [px of the full image]")
    footprint: float = parameter(0.6, "first scale, in sides of a cell seen at its depth [1]")
    opacity: float = parameter(0.9, "first opacity (0, 1); official 0.5")
    explained_opacity: float = parameter(
        0.8, "a pixel rendered less opaque than this is not explained by the map yet [1]"
    )
    far_factor: float = parameter(
        10.0, "nothing is inserted beyond this many median depths [1], as L_depth"
    )


@dataclass(frozen=True)
class DensityConfig:
    """When Gaussians are cloned, split and removed."""

    interval: int = parameter(100, "iterations between two rounds, official in initialisation")
    gradient: float = parameter(
        2e-4, "mean screen gradient above which a Gaussian is refined [1 per half image], official"
    )
    split_scale: float = parameter(
        0.02, "larger ones are split, smaller ones cloned [median depths], official 0.06 m"
    )
    split_shrink: float = parameter(1.6, "a child is this much smaller than its parent [1], 3DGS")
    prune_opacity: float = parameter(
        0.1, "fainter Gaussians are removed [1]; official 0.005 at first and 0.7 online"
    )
    prune_scale: float = parameter(
        0.2, "larger Gaussians are removed [median depths], official 0.6 m"
    )
    max_gaussians: int = parameter(
        0,
        "no cloning or splitting beyond this size of the map, 0 switches both off; paper: no limit."
        " In a few hundred iterations they gain nothing over a dense insertion (measured)",
    )


@dataclass(frozen=True)
class PoseRefinementConfig:
    """How the poses between the keyframes are refined by re-rendering, at full image size."""

    enabled: bool = parameter(True, "off: those poses stand on flow alone (fast mode of the paper)")
    iterations: int = parameter(
        5, "steps per frame at most; official 100 of Adam, ours divide by the curvature"
    )
    tolerance: float = parameter(
        0.05, "stop when a step moves the picture by less [px]; official |step| < 1e-4"
    )
    farthest: float = parameter(
        1.0,
        "a pose that moves the picture by more is not believed: matched flow is better than that "
        "[px of a 320x240 image]",
    )
    share: float = parameter(
        0.75,
        "how far to go from the pose that the flow says to the one that the picture says [0, 1]; "
        "official 1. The two err independently, so that a mean beats both (measured)",
    )
    rounding: float = parameter(
        0.01, "colour difference below which the L1 loss is rounded off [1], one step of noise"
    )


@dataclass(frozen=True)
class MappingConfig:
    """Budget, window, losses and step lengths. "official" names the authors' code.

    World units are arbitrary, so the official constants in metres are given in median depths of
    the first keyframes. `metric_median` says what a metre was when they were chosen.
    """

    image_scale: float = parameter(0.5, "size of the images used online, of the full size (0, 1]")
    init_iterations: int = parameter(150, "iterations on the first keyframes; official 1050")
    keyframe_iterations: int = parameter(25, "iterations per keyframe; official 450")
    keyframe_stride: int = parameter(
        1, "map and MLP are optimised at every n-th keyframe only; 5 in the paper's fast mode"
    )
    refine_iterations: int = parameter(700, "iterations at the end; official 20000, fast 3000")
    refine_full_share: float = parameter(
        0.4, "share of them, the last ones, at full image size [0, 1]; official 1"
    )

    window_size: int = parameter(10, "most keyframes in the local window, official")
    window_overlap: float = parameter(0.4, "least share of common Gaussians to stay, official")
    window_share: float = parameter(0.5, "probability of a keyframe of the window, paper 3.4")
    visible_contribution: float = parameter(
        0.5, "a Gaussian of more blending weight in a view is seen there [px]"
    )

    color_share: float = parameter(
        0.8, "alpha: lambda_5 = alpha / 2, lambda_6 = (1 - alpha) / 2; official 0.5 or 0.8"
    )
    lambda_ssim: float = parameter(0.2, "share of SSIM in L_color, Eq. (7), official")
    lambda_isotropic: float = parameter(10.0, "lambda_7: weight of L_iso [1 per m], official")
    metric_median: float = parameter(
        2.0, "median depth of a scene in which the official metres hold [m], our assumption"
    )
    floater_margin: float = parameter(
        0.5, "a surface this far in front of the reference is a floater [median depths]"
    )
    far_factor: float = parameter(
        10.0, "no depth loss beyond this many median depths [1], official"
    )

    mean_background: bool = parameter(
        True,
        "what no keyframe sees is rendered in the mean colour of the first ones; off: black,"
        " official",
    )

    means_rate: float = parameter(
        2e-3, "first Adam step of the means [median depths]; official 9.6e-4 m, decayed"
    )
    means_rate_end: float = parameter(
        0.1,
        "last step of the means over the first, log-linear over `rate_iterations`; official 0.01",
    )
    rate_iterations: int = parameter(1500, "iterations of that decay; official 30000")
    refine_rate_end: float = parameter(
        0.5, "last step over the first one in the refinement, all parameters; official 1"
    )
    rates: LearningRates = field(
        default_factory=lambda: LearningRates(
            quats_wxyz=2e-2, log_scales=2e-2, opacity_logits=5e-2, colors=5e-3
        ),
        metadata={"meaning": "Adam steps of the rest; longer than official: fewer iterations"},
    )

    insertion: InsertionConfig = field(
        default_factory=InsertionConfig, metadata={"meaning": "where Gaussians are inserted"}
    )
    density: DensityConfig = field(
        default_factory=DensityConfig, metadata={"meaning": "cloning, splitting and pruning"}
    )
    pose_refinement: PoseRefinementConfig = field(
        default_factory=PoseRefinementConfig,
        metadata={"meaning": "photometric refinement of the poses between the keyframes"},
    )
    freeze_iterations: int = parameter(
        5, "iterations without MLP training after a change of density; official 20 of 450"
    )

    def __post_init__(self) -> None:
        if not 0 < self.image_scale <= 1:
            raise InputError(
                f"expected an image scale in (0, 1], found {self.image_scale}; "
                "set mapping.image_scale to 1 for full size or 0.5 for half"
            )
        if self.keyframe_stride < 1:
            raise InputError(
                f"expected a stride of at least 1 keyframe, found {self.keyframe_stride}; "
                "set mapping.keyframe_stride to 1 to optimise the map at each of them"
            )
        if self.window_size < 3:
            raise InputError(
                f"expected a window of at least 3 keyframes, found {self.window_size}; "
                "two of them are always kept, set mapping.window_size to 10"
            )

    def rates_at(
        self,
        iteration: int,
        median_depth: float,  # world units, of the scene
        factor: float,  # on all steps
    ) -> LearningRates:
        """Return the step lengths of an iteration: those of the means decay, log-linear."""
        decay = self.means_rate_end ** min(1.0, iteration / self.rate_iterations)
        return LearningRates(
            means=factor * decay * self.means_rate * median_depth,
            quats_wxyz=factor * self.rates.quats_wxyz,
            log_scales=factor * self.rates.log_scales,
            opacity_logits=factor * self.rates.opacity_logits,
            colors=factor * self.rates.colors,
        )


def paper_mapping() -> MappingConfig:
    """Return the paper's and the official constants, for a GPU and an hour.

    The official learning rate of the means, 9.6e-4 m, is given in median depths of 2 m; the
    official first scale, 0.22 of the distance between neighbours, in cells.
    """
    return MappingConfig(
        image_scale=1.0,
        init_iterations=1050,
        keyframe_iterations=450,
        refine_iterations=20000,
        refine_full_share=1.0,
        refine_rate_end=1.0,
        color_share=0.5,
        mean_background=False,
        means_rate=4.8e-4,
        means_rate_end=0.01,
        rate_iterations=30000,
        rates=LearningRates(),
        insertion=InsertionConfig(cell=4, footprint=0.22, opacity=0.5),
        density=DensityConfig(max_gaussians=1_000_000),
        # The official 100 steps of Adam go as far as a few of ours: these are for hard frames.
        pose_refinement=PoseRefinementConfig(iterations=10, tolerance=0.01, share=1.0),
        freeze_iterations=20,
    )
