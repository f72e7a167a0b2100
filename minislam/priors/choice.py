"""From the names on the command line to flow, features and depth, each loaded and checked."""

from dataclasses import dataclass, field
from pathlib import Path

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
from minislam.priors.networks.depth_anything import DepthAnythingConfig, load_depth_anything
from minislam.priors.networks.dinov2 import load_dino_features
from minislam.priors.networks.droid import DroidFlowConfig, load_droid
from minislam.priors.networks.metric3d import Metric3DConfig, load_metric3d
from minislam.records import Sequence

FILES = "files:"  # before the name of a folder
_MAKERS = {"dinov2": "DINOv2", "fit3d": "FiT3D"}  # how a checkpoint of these features calls itself
_NETWORKS = {
    "flow": ("droid",),
    "features": tuple(_MAKERS),
    "depth": ("metric3d", "depth-anything"),
}


@dataclass(frozen=True)
class PriorChoice:
    """Which priors a run uses: the values of the flags of these names."""

    flow: str = "classical"
    flow_weights: str | None = None
    features: str = "classical"
    features_weights: str | None = None
    depth: str = "none"
    depth_weights: str | None = None
    depth_scale: float = 5000.0  # counts of a 16-bit depth .png per world unit
    device: str = "cpu"  # where networks run, cpu or cuda; everything else stays on the CPU

    def __post_init__(self) -> None:
        """Refuse a device that is none."""
        if self.device not in ("cpu", "cuda"):
            raise InputError(f"expected --device cpu or cuda, found {self.device!r}; choose one")


@dataclass(frozen=True)
class NetworksConfig:
    """How the pretrained networks are used, where they are."""

    droid: DroidFlowConfig = field(default_factory=DroidFlowConfig)
    metric3d: Metric3DConfig = field(default_factory=Metric3DConfig)
    depth_anything: DepthAnythingConfig = field(default_factory=DepthAnythingConfig)


def choose_flow(
    choice: PriorChoice, classical: ClassicalFlowConfig, networks: NetworksConfig
) -> FlowEstimator:
    """Return the flow: classical or droid."""
    weights = _weights(choice, "flow", choice.flow, choice.flow_weights)
    if choice.flow == "classical":
        return ClassicalFlow(classical)
    if choice.flow == "droid":
        return load_droid(weights, _device(choice), networks.droid)
    raise InputError(f"expected --flow classical or droid, found {choice.flow!r}; choose one")


def choose_features(
    choice: PriorChoice, camera: Camera, classical: ClassicalFeaturesConfig
) -> FeatureExtractor:
    """Return the features: classical, dinov2, fit3d, or files:FOLDER."""
    name = choice.features
    weights = _weights(choice, "features", name, choice.features_weights)
    if name == "classical":
        return ClassicalFeatures(config=classical)
    if name in _MAKERS:
        return load_dino_features(weights, _device(choice), kind=_MAKERS[name])
    if name.startswith(FILES):
        return FileFeatures(folder_of(name.removeprefix(FILES), FEATURES), camera)
    raise InputError(
        f"expected --features classical, dinov2, fit3d or files:FOLDER, found {name!r}; choose one"
    )


def choose_depth(
    choice: PriorChoice,
    sequence: Sequence,
    seed: int,
    simulated: SimulatedDepthConfig,
    networks: NetworksConfig,
) -> DepthPrior:
    """Return the depth: none, simulated, sensor, metric3d, depth-anything, or files:FOLDER."""
    name = choice.depth
    weights = _weights(choice, "depth", name, choice.depth_weights)
    if name == "none":
        return NoDepth()
    if name == "simulated":
        return _simulated_depth(sequence, seed, simulated)
    if name == "sensor":
        return SensorDepth(sequence.sensor_depth)
    if name == "metric3d":
        return load_metric3d(weights, _device(choice), networks.metric3d)
    if name == "depth-anything":
        return load_depth_anything(weights, _device(choice), networks.depth_anything)
    if name.startswith(FILES):
        return FileDepth(folder_of(name.removeprefix(FILES), DEPTH), 1 / choice.depth_scale)
    raise InputError(
        "expected --depth none, simulated, sensor, metric3d, depth-anything or files:FOLDER, found "
        f"{name!r}; choose one"
    )


def _simulated_depth(sequence: Sequence, seed: int, config: SimulatedDepthConfig) -> SimulatedDepth:
    truth = sequence.ground_truth
    if truth is None or truth.depth(0) is None:
        raise InputError(
            "expected a sequence with true depth for --depth simulated, found none in "
            f"{sequence.name}; use --depth none or --depth files:FOLDER"
        )
    return SimulatedDepth(truth.depth, seed, config)


def _weights(choice: PriorChoice, kind: str, name: str, weights: str | None) -> Path:
    """Return the file with the weights, or refuse one without a network and the reverse."""
    networks = _NETWORKS[kind]
    if name in networks and weights is None:
        raise InputError(
            f"expected --{kind}-weights FILE with --{kind} {name}, found none; give the official "
            "checkpoint, README.md says where to get it"
        )
    if name not in networks and weights is not None:
        raise InputError(
            f"expected --{kind} {' or '.join(networks)} with --{kind}-weights, found --{kind} "
            f"{name}; name the network of {weights}"
        )
    return Path(weights or "").expanduser()


def _device(choice: PriorChoice) -> torch.device:
    """Return where networks run, if that exists here."""
    if choice.device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "expected a GPU that this torch can use for --device cuda, found none; leave it out, "
            "or make the priors elsewhere with minislam priors"
        )
    return torch.device(choice.device)
