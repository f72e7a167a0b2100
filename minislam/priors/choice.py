"""Choose flow, features and depth by their names on the command line; load and check them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.depth import (
    FileDepth,
    NoDepth,
    SensorDepth,
    SimulatedDepth,
    SimulatedDepthConfig,
)
from minislam.priors.features import ClassicalFeatures, ClassicalFeaturesConfig
from minislam.priors.files import DEPTH, FEATURES, FileFeatures, folder_of
from minislam.priors.flow import ClassicalFlow
from minislam.priors.grid_flow import ClassicalFlowConfig
from minislam.priors.interfaces import DepthPrior, FeatureExtractor, FlowEstimator
from minislam.priors.networks.table import NETWORKS, NetworksConfig, find_network, load_network
from minislam.priors.plugins import PYTHON, load_plugin, plugin_names
from minislam.records import Sequence

FILES = "files:"  # before the name of a folder


@dataclass(frozen=True)
class PriorChoice:
    """Which priors a run uses: the values of the flags of these names."""

    flow: str = "classical"
    flow_weights: str | None = None
    features: str = "classical"
    features_weights: str | None = None
    depth: str = "none"
    depth_weights: str | None = None
    device: str = "cpu"  # where networks run, cpu or cuda; everything else stays on the CPU

    def __post_init__(self) -> None:
        """Refuse a device that is not there."""
        if self.device not in ("cpu", "cuda"):
            raise InputError(f"expected --device cpu or cuda, found {self.device!r}; choose one")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise InputError(
                "expected a GPU that this torch can use for --device cuda, found none; say "
                "--device cpu, or make the priors elsewhere with minislam priors"
            )


def choose_flow(
    choice: PriorChoice, classical: ClassicalFlowConfig, networks: NetworksConfig
) -> FlowEstimator:
    """Return the flow: classical, a network, or a plugin."""
    learned = _load(choice, "flow", choice.flow, choice.flow_weights, networks)
    if learned is not None:
        return learned
    if choice.flow == "classical":
        return ClassicalFlow(classical)
    raise _unknown("flow", choice.flow, ["classical", *_names("flow")])


def choose_features(
    choice: PriorChoice,
    camera: Camera,
    classical: ClassicalFeaturesConfig,
    networks: NetworksConfig,
) -> FeatureExtractor:
    """Return the features: classical, a network, a plugin, or files:FOLDER."""
    name = choice.features
    learned = _load(choice, "features", name, choice.features_weights, networks)
    if learned is not None:
        return learned
    if name == "classical":
        return ClassicalFeatures(classical)
    if name.startswith(FILES):
        return FileFeatures(folder_of(name.removeprefix(FILES), FEATURES), camera)
    raise _unknown("features", name, ["classical", *_names("features"), "files:FOLDER"])


def choose_depth(
    choice: PriorChoice,
    sequence: Sequence,
    seed: int,
    simulated: SimulatedDepthConfig,
    networks: NetworksConfig,
) -> DepthPrior:
    """Return the depth: none, simulated, sensor, a network, a plugin, or files:FOLDER."""
    name = choice.depth
    learned = _load(choice, "depth", name, choice.depth_weights, networks)
    if learned is not None:
        return learned
    if name == "none":
        return NoDepth()
    if name == "simulated":
        return _simulated_depth(sequence, seed, simulated)
    if name == "sensor":
        return SensorDepth(sequence.sensor_depth)
    if name.startswith(FILES):
        return FileDepth(folder_of(name.removeprefix(FILES), DEPTH), 1 / sequence.depth_scale)
    known = ["none", "simulated", "sensor", *_names("depth"), "files:FOLDER"]
    raise _unknown("depth", name, known)


def _simulated_depth(sequence: Sequence, seed: int, config: SimulatedDepthConfig) -> SimulatedDepth:
    truth = sequence.ground_truth
    if truth is None or truth.depth(0) is None:
        raise InputError(
            "expected a sequence with true depth for --depth simulated, found none in "
            f"{sequence.name}; use --depth none or --depth files:FOLDER"
        )
    return SimulatedDepth(truth.depth, seed, config)


def _load(
    choice: PriorChoice, kind: str, name: str, weights: str | None, networks: NetworksConfig
) -> Any:
    """Return the network or plugin of that name, None if it names none; refuse a file alone."""
    network = find_network(kind, name)
    if network is None:
        plugin = load_plugin(kind, name, choice.device, weights)
        if plugin is None and weights is not None:
            raise InputError(
                f"expected --{kind} {' or '.join(_names(kind))} with --{kind}-weights, found "
                f"--{kind} {name}; name the network of {weights}"
            )
        return plugin
    if weights is None:
        raise InputError(
            f"expected --{kind}-weights FILE with --{kind} {name}, found none; give the official "
            "checkpoint, minislam/priors/networks/README.md says where to get it"
        )
    return load_network(network, Path(weights).expanduser(), choice.device, networks)


def _unknown(kind: str, name: str, known: list[str]) -> InputError:
    names = ", ".join([*known, *plugin_names(kind)])
    return InputError(
        f"expected --{kind} {names} or {PYTHON}MODULE:FUNCTION, found {name!r}; choose one"
    )


def _names(kind: str) -> list[str]:
    return [network.name for network in NETWORKS if network.kind == kind]
