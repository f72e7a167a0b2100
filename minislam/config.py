"""All settings in one tree of dataclasses, and the presets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from minislam.errors import require
from minislam.mapping.config import MappingConfig
from minislam.parameters import flattened, leaves, parameter, with_values
from minislam.priors.networks.table import NetworksConfig
from minislam.tracking.config import TrackingConfig
from minislam.uncertainty.config import UncertaintyConfig

OTHER_PARTS = ("sequence", "input", "priors")  # of config.json, beside the settings


@dataclass(frozen=True)
class SlamConfig:
    """The whole configuration. Names with dots reach every part: `tracking.window`."""

    seed: int = parameter(0, "seed of every random draw: same seed, same bytes", most=2**63 - 1)
    checkpoint_fraction: float = parameter(0.01, "fraction of the time for checkpoints; 0: none")
    threads: int = parameter(1, "threads of torch; more are slower on a busy machine", 1, 256)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    uncertainty: UncertaintyConfig = field(default_factory=UncertaintyConfig)
    networks: NetworksConfig = field(default_factory=NetworksConfig)


def settings_of(config: SlamConfig) -> dict[str, Any]:
    """Return all values of a configuration, by their names with dots."""
    return {name: value for name, value, _ in leaves(config)}


# The constants of the paper and of the official code in our units, where they differ from the
# default tree; a scene has a median depth of 2 m. The rounds of a learned flow are official.
_PAPER: dict[str, Any] = {
    "tracking.warmup_keyframes": 12,
    "tracking.learned.keyframe_flow": 15.0,  # officially 3 cells, 24 px, in 512x384
    "tracking.learned.keyframe_flow_without_prior": 15.0,
    "tracking.learned.warmup_rounds": 8 + 8,
    "tracking.learned.warmup_rounds_with_beta": 8,
    "tracking.loop_min_gap": 21,
    "tracking.learned.window": 25,
    "tracking.learned.rounds": 8 + 4,
    "tracking.learned.active_edges": 75,
    "tracking.learned.final_rounds": 7 + 12,
    "tracking.learned.pose_rounds": 12,
    "mapping.image_scale": 1.0,
    "mapping.views_per_step": 1,
    "mapping.init_iterations": 1050,
    "mapping.keyframe_iterations": 450,
    "mapping.refine_iterations": 20000,
    "mapping.refine_images": 0,
    "mapping.refine_full_fraction": 1.0,
    "mapping.freeze_iterations": 20,
    "mapping.color_weight": 0.5,
    "mapping.mean_background": False,
    "mapping.means_rate": 4.8e-4,  # officially 9.6e-4 m
    "mapping.means_rate_end": 0.01,
    "mapping.rate_iterations": 30000,
    "mapping.quats_rate": 1e-3,
    "mapping.log_scales_rate": 6e-3,
    "mapping.colors_rate": 7.05e-4,
    "mapping.refine_rate_end": 1.0,
    "mapping.insertion.cell": 4,  # officially 1/16 of the pixels, online 1/32
    "mapping.insertion.plain": 0.0,
    "mapping.insertion.footprint": 0.22,  # officially of the distance between neighbours
    "mapping.insertion.opacity": 0.5,
    "mapping.density.max_gaussians": 1_000_000,
    "mapping.pose_refinement.enabled": True,
    "uncertainty.learning_rate": 4e-4,
    "uncertainty.median_size": 5,
    "networks.droid.chain_updates": 1,
}
# What each preset changes. `laptop` is the default tree: a 100-frame clip in minutes on two cores.
PRESETS: dict[str, dict[str, Any]] = {
    "laptop": {},
    # For a GPU and hours: half a frame per second on the authors' machine.
    "paper": _PAPER,
    # The fast mode of the paper's supplement: four times as fast for 0.02 cm of ATE.
    "paper-fast": _PAPER
    | {
        "tracking.prior_mask": False,
        "mapping.keyframe_stride": 5,
        "mapping.refine_iterations": 3000,
        "mapping.pose_refinement.enabled": False,
    },
    "test": {
        "tracking.warmup_rounds": 2,
        "tracking.warmup_rounds_with_beta": 1,
        "tracking.rounds": 1,
        "tracking.final_rounds": 1,
        "mapping.init_iterations": 60,
        "mapping.keyframe_iterations": 10,
        "mapping.refine_iterations": 60,
        "mapping.image_scale": 1.0,
        "tracking.learned.warmup_rounds": 2,
        "tracking.learned.warmup_rounds_with_beta": 2,
        "tracking.learned.final_rounds": 4,
        "tracking.learned.rounds": 1,
        "tracking.learned.pose_rounds": 1,
        "networks.droid.chain_updates": 1,
        "networks.metric3d.size": (112, 168),
        "networks.depth_anything.shorter_side": 70,
    },
}


def preset(name: str) -> SlamConfig:
    """Return a preset by name."""
    require(name in PRESETS, f"a preset among {', '.join(PRESETS)}", f"{name!r}; choose one")
    return with_settings(SlamConfig(), PRESETS[name])


def with_settings(config: SlamConfig, settings: Mapping[str, Any]) -> SlamConfig:
    """Return the configuration with values replaced; they are given by their names with dots."""
    # With a learned flow tracking.learned.X replaces tracking.X. Given alone, tracking.X is both.
    known = settings_of(config)
    also = {n.replace("tracking.", "tracking.learned.", 1): v for n, v in settings.items()}
    also = {n: v for n, v in also.items() if n in known and n not in settings}
    return with_values(config, {**settings, **also})


def settings_in(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the settings in a config.json by their names with dots, without its other parts."""
    flat = flattened(tree)
    return {name: flat[name] for name in flat if name.partition(".")[0] not in OTHER_PARTS}
