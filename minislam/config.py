"""All settings in one tree of dataclasses, the presets, and the conversion from and to JSON."""

import dataclasses
import difflib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from minislam.errors import InputError
from minislam.mapping.config import MappingConfig, paper_mapping
from minislam.parameters import parameter, require_bounds
from minislam.priors.depth import SimulatedDepthConfig
from minislam.priors.grid_flow import ClassicalFlowConfig
from minislam.priors.networks.droid import DroidFlowConfig
from minislam.priors.networks.table import NetworksConfig
from minislam.tracking.config import TrackingConfig, paper_schedule
from minislam.uncertainty.config import UncertaintyConfig, paper_uncertainty

OTHER_PARTS = ("sequence", "input", "priors")  # of config.json, beside the settings


@dataclass(frozen=True)
class SlamConfig:
    """The whole configuration. Names with dots reach every part: `tracking.window`."""

    seed: int = parameter(0, "seed of every random draw: same seed, same bytes", most=2**63 - 1)
    checkpoint_fraction: float = parameter(
        0.01, "fraction of a run's time that writing checkpoints may take [-]; 0 writes none"
    )
    threads: int = parameter(1, "threads of torch; more are slower on a busy machine", 1, 256)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    uncertainty: UncertaintyConfig = field(default_factory=UncertaintyConfig)
    flow: ClassicalFlowConfig = field(default_factory=ClassicalFlowConfig)
    simulated_depth: SimulatedDepthConfig = field(default_factory=SimulatedDepthConfig)
    networks: NetworksConfig = field(default_factory=NetworksConfig)


def settings_of(config: Any) -> dict[str, Any]:
    """Return all values of a configuration, by their names with dots."""
    return {name: value for name, value, _ in _leaves(config)}


def _leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Yield name, value, and meaning with bounds, of every setting in a tree of dataclasses."""
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            yield from _leaves(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, value, entry.metadata


def _paper_settings() -> dict[str, Any]:
    """Return the values in which the paper and the official code differ from the default tree."""
    paper = SlamConfig(
        tracking=TrackingConfig(warmup_keyframes=12, learned=paper_schedule()),
        mapping=paper_mapping(),
        uncertainty=paper_uncertainty(),
        networks=NetworksConfig(DroidFlowConfig(chain_updates=1)),
    )
    default = settings_of(SlamConfig())
    return {name: value for name, value in settings_of(paper).items() if value != default[name]}


# What each preset changes. `laptop` is the default tree: a 100-frame clip in minutes on two cores.
PRESETS: dict[str, dict[str, Any]] = {
    "laptop": {},
    # For a GPU and hours: half a frame per second on the authors' machine.
    "paper": _paper_settings(),
    # The fast mode of the paper's supplement: four times as fast for 0.02 cm of ATE.
    "paper-fast": _paper_settings()
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
    if name not in PRESETS:
        raise InputError(f"expected a preset among {', '.join(PRESETS)}, found {name!r}")
    return with_settings(SlamConfig(), PRESETS[name])


def metadata_of(config: Any) -> dict[str, Mapping[str, Any]]:
    """Return meaning, least and most of each value of a configuration, by its name with dots."""
    return {name: metadata for name, _, metadata in _leaves(config)}


def with_settings(config: SlamConfig, settings: dict[str, Any]) -> SlamConfig:
    """Return the configuration with values replaced; they are given by their names with dots."""
    known = settings_of(config)
    # With a learned flow tracking.learned.X replaces tracking.X. Whoever gives only one means both.
    also = {n.replace("tracking.", "tracking.learned.", 1): v for n, v in settings.items()}
    settings = settings | {n: v for n, v in also.items() if n in known and n not in settings}
    metadata = metadata_of(config)
    for name, value in settings.items():
        if value == {} and any(other.startswith(f"{name}.") for other in known):
            continue  # a part of which nothing is given
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
            raise InputError(f"expected a known setting, found {name!r}; the nearest is {near[0]}")
        converted = _converted(name, value, known[name])
        require_bounds(name, converted, metadata[name]["least"], metadata[name]["most"])
        config = _replaced(config, name.split("."), converted)
    return config


def _replaced(config: Any, path: list[str], value: Any) -> Any:
    if len(path) > 1:
        value = _replaced(getattr(config, path[0]), path[1:], value)
    return replace(config, **{path[0]: value})


def _converted(name: str, value: Any, present: Any) -> Any:
    """Convert a value from JSON or from the command line to the type of the present value."""
    kind = type(present)
    try:
        if kind is bool:
            words = {"true": True, "false": False, "1": True, "0": False, "on": True, "off": False}
            return value if isinstance(value, bool) else words[str(value).lower()]
        if kind is tuple:
            parts = value.split(",") if isinstance(value, str) else value
            return tuple(type(present[0])(part) for part in parts)
        converted = kind(value)
        # int(2.5) and float("nan") succeed, but are always mistakes.
        is_wrong = isinstance(value, bool) or not math.isfinite(converted)
        if is_wrong or (not isinstance(value, str) and converted != value):
            raise ValueError
        return converted
    except (KeyError, OverflowError, TypeError, ValueError):
        raise InputError(
            f"expected {name} to be of type {kind.__name__} like {present!r}, found {value!r}"
        ) from None


def as_json(config: SlamConfig) -> dict[str, Any]:
    """Return the configuration as nested dictionaries of plain values."""
    return dataclasses.asdict(config)


def from_json(tree: dict[str, Any]) -> SlamConfig:
    """Return the configuration in a config.json; values left out keep their defaults."""
    return with_settings(SlamConfig(), settings_in(tree))


def settings_in(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the settings in a config.json by their names with dots, without its other parts."""
    flat = flattened(tree)
    return {name: flat[name] for name in flat if name.partition(".")[0] not in OTHER_PARTS}


def flattened(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested dictionaries as a single one, with names that contain dots."""
    if not isinstance(tree, dict):
        raise InputError(
            f"expected settings as a JSON object, found {type(tree).__name__}; write "
            '{"tracking": {"window": 8}} or {"tracking.window": 8}'
        )
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
