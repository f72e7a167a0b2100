"""Choose flow, features and depth by their names on the command line; load and check them.

How to write one, and name it by `python:MODULE:FACTORY` or an entry point: networks/README.md.
"""

import sys
from collections.abc import Callable, Iterable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import torch

from minislam.errors import InputError, require
from minislam.geometry import Camera
from minislam.parameters import user_path
from minislam.priors import conformance, names
from minislam.priors.depth import NoDepth, SensorDepth, SimulatedDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.files import DEPTH, FEATURES, FileDepth, FileFeatures, folder_of
from minislam.priors.flow import ClassicalFlow
from minislam.priors.interfaces import DepthPrior, FeatureExtractor, FlowEstimator
from minislam.priors.names import FILES, FOLDER, PYTHON, PriorChoice, plugins, require_prior
from minislam.priors.networks.table import NETWORKS, NetworksConfig, load_network
from minislam.records import Sequence

Makers = dict[str, Callable[[], Any]]  # by name, of what needs no weights

_CHECKS = {
    "flow": conformance.check_flow_estimator,
    "features": conformance.check_feature_extractor,
    "depth": conformance.check_depth_prior,
}


def choose_flow(choice: PriorChoice, networks: NetworksConfig) -> FlowEstimator:
    """Return the flow: classical, a network, or a plugin."""
    return _choose("flow", choice, networks, {"classical": ClassicalFlow})


def choose_features(
    choice: PriorChoice, camera: Camera, networks: NetworksConfig, sequence: Sequence | None = None
) -> FeatureExtractor:
    """Return the features: classical, a network, a plugin, or files:FOLDER of a sequence."""
    makers: Makers = {
        "classical": ClassicalFeatures,
        FOLDER: lambda: FileFeatures(folder_of(choice.features, FEATURES), camera, sequence),
    }
    return _choose("features", choice, networks, makers)


def choose_depth(
    choice: PriorChoice, sequence: Sequence, seed: int, networks: NetworksConfig
) -> DepthPrior:
    """Return the depth: none, simulated, sensor, a network, a plugin, or files:FOLDER."""
    makers: Makers = {
        "none": NoDepth,
        "simulated": lambda: _simulated_depth(sequence, seed),
        "sensor": lambda: _sensor_depth(sequence),
        FOLDER: lambda: _depth_files(sequence, folder_of(choice.depth, DEPTH)),
    }
    return _choose("depth", choice, networks, makers)


def _choose(kind: str, choice: PriorChoice, networks: NetworksConfig, makers: Makers) -> Any:
    """Return the prior that --KIND and --KIND-weights name."""
    name = getattr(choice, kind)
    weights = require_prior(kind, name, getattr(choice, f"{kind}_weights"))
    network = next((n for n in NETWORKS if (n.kind, n.name) == (kind, name)), None)
    if network is not None:
        path, precision = user_path(str(weights)), names.PRECISIONS[choice.precision]
        return load_network(network, path, choice.device, networks, getattr(torch, precision))
    maker = makers.get(FOLDER if name.startswith(FILES) else name)
    return maker() if maker else load_plugin(kind, name, choice.device, weights)


def load_plugin(kind: str, name: str, device: str, weights: str | None) -> Any:
    """Return the prior that --KIND NAME names in a module or an installed package, checked."""
    if name.startswith(PYTHON):
        if "" not in sys.path:
            # The current folder, which `minislam` alone does not look into. It stays: what was
            # loaded may import more when it is called.
            sys.path.append("")
        entry = EntryPoint(name, name.removeprefix(PYTHON), f"minislam.{kind}")
    else:
        entry = plugins(kind)[name]
    try:
        make = entry.load()
        prior = make(device) if weights is None else make(device, weights)
    except (Exception, SystemExit) as error:
        wanted = f"--{kind} {name} to name a function that makes a prior of a device"
        found = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        advice = f"write it like {PYTHON}MODULE:FUNCTION, see minislam/priors/networks/README.md"
        raise InputError(f"expected {wanted}, found {found}; {advice}") from error
    _CHECKS[kind](prior, f"--{kind} {name}")
    return prior


def _sensor_depth(sequence: Sequence) -> SensorDepth:
    depths = map(sequence.sensor_depth, range(len(sequence)))
    _require_some(depths, f"a sensor's depth in {sequence.name}", "use another --depth")
    return SensorDepth(sequence.sensor_depth)


def _depth_files(sequence: Sequence, folder: Path) -> FileDepth:
    depth = FileDepth(folder, sequence.read_depth)
    depth.files.require_frames_of(sequence)
    depths = (depth(sequence.frame(index), sequence.camera) for index in range(len(sequence)))
    advice = "name the files by frame index, and write metres, not 0 or NaN"
    _require_some(depths, f"depth of any frame in {folder}", advice)
    return depth


def _require_some(depths: Iterable[Any], what: str, advice: str) -> None:
    """Refuse depths that are unknown everywhere; the first that is known ends the search."""
    is_known = any(depth is not None and bool((depth > 0).any()) for depth in depths)
    require(is_known, what, f"none; {advice}")


def _simulated_depth(sequence: Sequence, seed: int) -> SimulatedDepth:
    truth = sequence.ground_truth
    depth = truth.depth if truth else lambda index: None
    wanted = f"true depth in {sequence.name} for --depth simulated"
    advice = "use --depth none or --depth files:FOLDER"
    _require_some(map(depth, range(len(sequence))), wanted, advice)
    return SimulatedDepth(depth, seed)
