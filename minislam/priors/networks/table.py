"""The table of pretrained networks, read by `choice.py` and `minislam weights`.

To add a network, write a `FlowEstimator`, a `FeatureExtractor`, or a `DepthPrior` with a method
`network` behind its resizing; then rows in NETWORKS and weights.csv, settings in NetworksConfig.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from minislam.errors import InputError
from minislam.priors.networks.checkpoints import Weights, load_checkpoint
from minislam.priors.networks.depth_anything import DepthAnything, DepthAnythingConfig
from minislam.priors.networks.droid import DroidFlow, DroidFlowConfig
from minislam.priors.networks.metric3d import Metric3DConfig, Metric3DDepth
from minislam.priors.networks.vit import DinoFeatures
from minislam.records import Frame


@dataclass(frozen=True)
class NetworksConfig:
    """Settings of the pretrained networks."""

    droid: DroidFlowConfig = field(default_factory=DroidFlowConfig)
    metric3d: Metric3DConfig = field(default_factory=Metric3DConfig)
    depth_anything: DepthAnythingConfig = field(default_factory=DepthAnythingConfig)


@dataclass(frozen=True)
class Network:
    """A row of the table."""

    kind: str  # what it computes: "flow", "features" or "depth", as the flags are called
    name: str  # the value of the flag --KIND
    title: str  # what messages call it
    marks: tuple[str, ...]  # tensors by which its checkpoint is recognised
    make: Callable[[Weights, NetworksConfig], Any]
    unneeded: tuple[str, ...] = ()  # parts of names that are stored in its files but not used
    is_strict: bool = True  # its official loader refuses further tensors, as we do; else we warn


# A checkpoint belongs to the first row whose marks it holds.
NETWORKS = (
    Network(
        "flow", "droid", "DROID-SLAM", ("update.gru.convz.weight",),
        lambda weights, config: DroidFlow(weights, config.droid),
        # Upsampling of disparities, since the map takes denser depth; MegaSaM's own.
        unneeded=("update.agg.upmask.", "update.agg_motion."),
    ),
    Network(
        "features", "dinov2", "DINOv2", ("blocks.0.ls1.gamma", "mask_token"),
        lambda weights, config: DinoFeatures(weights),
        unneeded=("mask_token",),  # used in training only, here and below
    ),
    Network(
        "features", "fit3d", "FiT3D", ("blocks.0.ls1.gamma", "patch_embed.proj.weight"),
        lambda weights, config: DinoFeatures(weights),
    ),
    Network(
        "depth", "metric3d", "Metric3D v2",
        ("depth_model.decoder.token2feature.read_0.readoper.project_patch.weight",),
        lambda weights, config: Metric3DDepth(weights, config.metric3d.size),
        unneeded=("mask_token", "norm3."),  # norm3 is another norm under a second name
        is_strict=False,
    ),
    Network(
        "depth", "depth-anything", "Depth Anything V2", ("depth_head.scratch.output_conv1.weight",),
        lambda weights, config: DepthAnything(weights, config.depth_anything),
        # Stored, but unused: at the coarsest level there is no map to add.
        unneeded=("mask_token", "refinenet4.resConfUnit1."),
    ),
)  # fmt: skip
LPIPS_HEADS, CLASSIFIER = "LPIPS linear weights", "an image classifier of torchvision"
_OTHER_MARKS = {"lin0.model.1.weight": LPIPS_HEADS, "features.0.weight": CLASSIFIER}


def recognise(weights: Weights) -> Network | None:
    """Return the network that a checkpoint belongs to, by the names of its tensors."""
    return next((n for n in NETWORKS if all(mark in weights for mark in n.marks)), None)


def describe(weights: Weights) -> str:
    """Say in a few words which network a checkpoint belongs to."""
    network = recognise(weights)
    if network is None:
        names = sorted(weights)
        unknown = f"something unknown ({len(names)} tensors, the first is {names[0]})"
        return next((other for mark, other in _OTHER_MARKS.items() if mark in weights), unknown)
    patches = next((name for name in weights if name.endswith("patch_embed.proj.weight")), None)
    if patches is None:
        return network.title
    has_registers = any(name.endswith(("register_tokens", "reg_token")) for name in weights)
    registers = "with registers" if has_registers else "no registers"
    return f"{network.title} (ViT of width {len(weights[patches])}, {registers})"


def load_network(
    network: Network,
    path: Path | str,
    device: torch.device | str = "cpu",
    config: NetworksConfig = NetworksConfig(),
    precision: torch.dtype = torch.float32,
) -> Any:  # a FlowEstimator, FeatureExtractor or DepthPrior
    """Return a network from its checkpoint file, which is checked."""
    weights = load_checkpoint(path, device)
    weights.precision = precision
    if recognise(weights) is not network:
        found = f"{weights.file}, which looks like {describe(weights)}"
        advice = "give the file that belongs to this network"
        raise InputError(f"expected a {network.title} checkpoint, found {found}; {advice}")
    return build_checked(network, weights, config)


def build_checked(
    network: Network, weights: Weights, config: NetworksConfig = NetworksConfig()
) -> Any:  # a FlowEstimator, FeatureExtractor or DepthPrior
    """Return a network whose tensors are checked: all are there, fit together, and are needed."""
    try:
        with torch.no_grad():
            built = network.make(weights, config)
            _run_once(built, network.kind)
    except (RuntimeError, IndexError, ValueError) as error:
        wanted = f"the shapes of {network.title} in {weights.file}"
        found = f"tensors that do not fit together ({str(error).splitlines()[0]})"
        raise InputError(f"expected {wanted}, found {found}; it is another version") from error
    extra = [n for n in weights.unused() if not any(part in n for part in network.unneeded)]
    if extra:
        wanted = f"only the tensors of {network.title} in {weights.file}"
        problem = f"expected {wanted}, found {len(extra)} more, such as {extra[0]}"
        if network.is_strict:
            raise InputError(f"{problem}; it is another version of the network")
        warnings.warn(f"{problem}; they are not used", stacklevel=2)
    return built


def _run_once(built: Any, kind: str) -> None:
    """Run a network on a tiny image, so that it asks for every tensor it needs."""
    image = torch.zeros(64, 64, 3)  # px; DROID's coarsest correlation needs that many
    if kind == "flow":
        built.add_frame(0, image)
        built.match([0], [0], torch.zeros(1, 2, 8 * 8))
        built.remove_frame(0)
    elif kind == "features":
        built(Frame(0, 0.0, image))
    else:
        built.network(torch.zeros(1, 3, 28, 28, device=built.device))
