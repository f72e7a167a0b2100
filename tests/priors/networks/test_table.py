"""The table of networks: files are recognised, and used only if whole and of the right network."""

from pathlib import Path

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.depth_anything import DepthAnythingConfig
from minislam.priors.networks.metric3d import Metric3DConfig
from minislam.priors.networks.table import (
    NETWORKS,
    NetworksConfig,
    describe,
    find_network,
    load_network,
)
from tests.checkpoint_files import tiny_fit3d, write
from tests.helpers import frame_of, generator
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

DROID, DINOV2, FIT3D, METRIC3D, DEPTH_ANYTHING = NETWORKS
SMALL = NetworksConfig(
    metric3d=Metric3DConfig((56, 84)),
    depth_anything=DepthAnythingConfig(shorter_side=28, depth_limit=20.0),
)


@pytest.fixture(scope="module")
def tensors() -> dict[str, torch.Tensor]:
    return tiny_fit3d()


# Known answers


def test_a_network_is_found_by_its_flag():
    assert find_network("depth", "metric3d") is METRIC3D
    assert find_network("flow", "metric3d") is None


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ("dinov2_vits14", "DINOv2 (ViT of width 384, no registers)"),
        ("dinov2_vits14_reg", "DINOv2 (ViT of width 384, with registers)"),
        ("fit3d_small", "FiT3D (ViT of width 384, no registers)"),
        ("fit3d_reg_small", "FiT3D (ViT of width 384, with registers)"),
        ("depth_anything_v2_vitl", "Depth Anything V2 (ViT of width 1024, no registers)"),
        ("metric3d_vit_large", "Metric3D v2 (ViT of width 1024, with registers)"),
    ],
)
def test_files_are_recognised_by_their_names(network: str, words: str):
    shapes = rebuilt.shapes_of(network)
    empty = {n: torch.empty(s, device="meta") for n, s in shapes.items()}
    assert describe(Weights(empty, "w.pth")) == words


def test_other_files_are_described():
    one = torch.zeros(1)
    assert describe(Weights({"features.0.weight": one}, "f")).startswith("an image classifier")
    assert "1 tensors, the first is abc" in describe(Weights({"abc": one}, "f"))
    assert describe(Weights({"update.gru.convz.weight": one}, "f")) == "DROID-SLAM"


# Identities


def test_a_good_file_loads_and_runs(tmp_path: Path, tensors):
    features = load_network(FIT3D, write(tmp_path / "w.pth", tensors))
    assert features(frame_of(torch.zeros(28, 42, 3))).shape == (2, 3, 384)


@pytest.mark.parametrize(
    ("network", "name", "removed"),
    [
        (METRIC3D, "metric3d_vit_small", "depth_model.decoder.update_block.mask.2.bias"),
        (DEPTH_ANYTHING, "depth_anything_v2_vits", "depth_head.scratch.output_conv2.2.bias"),
    ],
)
def test_depth_networks_are_checked_and_run(tmp_path: Path, network, name: str, removed: str):
    tensors = rebuilt.weights_of(name).as_dict()
    path = write(tmp_path / "w.pth", {"model_state_dict": tensors})
    prior = load_network(network, path, config=SMALL)
    assert prior(frame_of(torch.zeros(30, 40, 3)), Camera(30, 30, 20, 15, 40, 30)).shape == (30, 40)
    with pytest.raises(InputError, match=r"1 more, such as extra"):
        load_network(network, write(path, {**tensors, "extra": torch.zeros(1)}), config=SMALL)
    del tensors[removed]
    with pytest.raises(InputError, match=f"expected the tensor {removed}"):
        load_network(network, write(path, tensors), config=SMALL)


def test_a_checkpoint_of_a_parallel_training_is_checked_and_runs(tmp_path: Path):
    tensors = {f"module.{n}": t for n, t in rebuilt.weights_of("droid").as_dict().items()}
    for head in ("delta", "weight"):  # as published: a third channel
        for kind in ("weight", "bias"):
            name = f"module.update.{head}.2.{kind}"
            tensors[name] = torch.cat([tensors[name], tensors[name][:1]])
    torch.save(tensors, tmp_path / "droid.pth")
    flow = load_network(DROID, tmp_path / "droid.pth")
    image = torch.rand(64, 72, 3, generator=generator(0))
    _, matches = flow.start_chain(image).advance(image)
    assert torch.isfinite(matches.targets).all()
    torch.save({**tensors, "module.update.agg_motion.0.weight": torch.zeros(1)}, tmp_path / "d.pth")
    with pytest.raises(InputError, match=r"found 1 more, such as update\.agg_motion"):
        load_network(DROID, tmp_path / "d.pth")
    del tensors["module.cnet.conv2.bias"]
    torch.save(tensors, tmp_path / "d.pth")
    with pytest.raises(InputError, match=r"expected the tensor cnet\.conv2\.bias"):
        load_network(DROID, tmp_path / "d.pth")


# Errors


def test_another_network_is_named(tmp_path: Path):
    path = write(tmp_path / "droid.pth", {"module.update.gru.convz.weight": torch.zeros(1)})
    sentence = r"expected a FiT3D checkpoint, found .*droid\.pth, which looks like DROID"
    with pytest.raises(InputError, match=sentence):
        load_network(FIT3D, path)


def test_missing_unexpected_and_misshapen_tensors_are_named(tmp_path: Path, tensors):
    missing = {n: t for n, t in tensors.items() if n != "blocks.1.mlp.fc2.weight"}
    with pytest.raises(InputError, match=r"expected the tensor blocks\.1\.mlp\.fc2\.weight"):
        load_network(FIT3D, write(tmp_path / "a.pth", missing))
    extra = {**tensors, "blocks.0.attn.lora": torch.zeros(1)}
    with pytest.raises(InputError, match=r"found 1 more, such as blocks\.0\.attn\.lora"):
        load_network(FIT3D, write(tmp_path / "b.pth", extra))
    misshapen = {**tensors, "blocks.0.mlp.fc1.weight": torch.zeros(1536, 383)}
    with pytest.raises(InputError, match="do not fit together"):
        load_network(FIT3D, write(tmp_path / "c.pth", misshapen))
    misshapen = {**tensors, "cls_token": torch.zeros(1, 1, 12)}
    with pytest.raises(InputError, match="do not fit together"):
        load_network(FIT3D, write(tmp_path / "d.pth", misshapen))


def test_dinov2_and_fit3d_can_be_told_apart(tmp_path: Path, tensors):
    path = write(tmp_path / "fit3d.pth", tensors)
    assert load_network(FIT3D, path).dimension == 384
    with pytest.raises(InputError, match=r"expected a DINOv2 checkpoint, .*looks like FiT3D"):
        load_network(DINOV2, path)
