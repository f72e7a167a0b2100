"""The table of networks: files are recognised, and used only if whole and of the right network."""

from pathlib import Path

import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.networks import table
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.depth_anything import DepthAnythingConfig
from minislam.priors.networks.metric3d import Metric3DConfig
from minislam.priors.networks.table import (
    NETWORKS,
    NetworksConfig,
    build_checked,
    describe,
    load_network,
    recognise,
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


def on_meta(network: str) -> Weights:
    """Return official names and shapes without numbers, where a run computes shapes only."""
    shapes = rebuilt.shapes_of(network)
    return Weights({n: torch.empty(s, device="meta") for n, s in shapes.items()}, network)


# Known answers


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
    assert describe(on_meta(network)) == words


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
    write(path, {**tensors, "extra": torch.zeros(1)})
    # The official loader of Metric3D takes what it knows; that of Depth Anything refuses the file.
    refuses = pytest.warns(UserWarning, match=r"1 more, such as extra; they are not used")
    if network is DEPTH_ANYTHING:
        refuses = pytest.raises(InputError, match=r"1 more, such as extra")
    with refuses:
        load_network(network, path, config=SMALL)
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
    path = tmp_path / "d.pth"
    load_network(DROID, write(path, {**tensors, "module.update.agg_motion.0.weight": image}))
    with pytest.raises(InputError, match=r"found 1 more, such as update\.more"):
        load_network(DROID, write(path, {**tensors, "module.update.more": image}))
    for name, width, expected in (
        ("update.delta.2", 1, "2 or 3"),
        ("update.weight.2", 4, "2 or 3"),
        ("fnet.conv2", 64, "128"),
    ):
        heads = {
            f"module.{name}.{kind}": tensors[f"module.{name}.{kind}"] for kind in ("weight", "bias")
        }
        heads = {n: t.repeat_interleave(2, 0)[:width] for n, t in heads.items()}
        with pytest.raises(
            InputError, match=f"{expected} output channels of {name}.weight .*{width}"
        ):
            load_network(DROID, write(path, tensors | heads))
    del tensors["module.cnet.conv2.bias"]
    torch.save(tensors, tmp_path / "d.pth")
    with pytest.raises(InputError, match=r"expected the tensor cnet\.conv2\.bias"):
        load_network(DROID, tmp_path / "d.pth")


# Errors


def test_another_network_is_named(tmp_path: Path):
    path = write(tmp_path / "droid.pth", {"module.update.gru.convz.weight": torch.ones(1)})
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


def test_all_28_swaps_of_files_are_refused_by_name(monkeypatch: pytest.MonkeyPatch):
    files = {
        "droid": DROID, "dinov2_vits14": DINOV2, "dinov2_vits14_reg": DINOV2, "fit3d_small": FIT3D,
        "fit3d_reg_small": FIT3D, "metric3d_vit_small": METRIC3D,
        "depth_anything_v2_vits": DEPTH_ANYTHING,
    }  # fmt: skip
    monkeypatch.setattr(table, "load_checkpoint", lambda path, device: on_meta(path))
    swaps = [(file, n) for file, own in files.items() for n in NETWORKS if n is not own]
    assert len(swaps) == 28
    for file, network in swaps:
        sentence = f"expected a {network.title} checkpoint, found {file}.*like {files[file].title}"
        with pytest.raises(InputError, match=sentence):
            load_network(network, file)


@pytest.mark.parametrize("kept", [6, 11])
@pytest.mark.parametrize(
    ("network", "name", "block"),
    [
        (DINOV2, "dinov2_vits14", "blocks.{}."),
        (FIT3D, "fit3d_reg_small", "blocks.{}."),
        (METRIC3D, "metric3d_vit_large", "depth_model.encoder.blocks.0.{}."),
        (DEPTH_ANYTHING, "depth_anything_v2_metric_hypersim_vits", "pretrained.blocks.{}."),
    ],
)
def test_a_transformer_without_its_last_blocks_is_refused(network, name, block: str, kept: int):
    tensors = on_meta(name.replace("metric_hypersim_", "")).as_dict()
    gone = tuple(block.format(k) for k in range(kept, 24))
    left = Weights({n: t for n, t in tensors.items() if not n.startswith(gone)}, name)
    with pytest.raises(InputError, match=rf"expected the tensor .*\.{kept}\.norm1.*not complete"):
        build_checked(network, left, SMALL)


@pytest.mark.parametrize(
    ("name", "file", "lost"),
    [
        ("dinov2_vits14_reg", "dinov2_vits14_reg4_pretrain.pth", "register_tokens"),
        ("dinov2_vits14_reg", "renamed.pth", "mask_token"),
        ("dinov2_vits14", "dinov2_vits14_pretrain.pth", "mask_token"),
        ("fit3d_reg_small", "dinov2_reg_small_finetuned.pth", "reg_token"),
    ],
)
def test_lost_tokens_do_not_make_another_network_of_a_file(name: str, file: str, lost: str):
    tensors = on_meta(name).as_dict()
    del tensors[lost]
    weights = Weights(tensors, f"somewhere/{file}")
    with pytest.raises(
        InputError, match=r"expected (mask_token|register tokens) in .*not complete"
    ):
        build_checked(recognise(weights), weights)


@pytest.mark.parametrize(
    ("network", "name", "head", "width"),
    [
        (DEPTH_ANYTHING, "depth_anything_v2_vits", "depth_head.scratch.output_conv2.2", 2),
        (METRIC3D, "metric3d_vit_small", "depth_model.decoder.depth_regressor.2", 1),
        (METRIC3D, "metric3d_vit_small", "depth_model.decoder.update_block.flow_head.conv2d", 1),
    ],
)
def test_heads_of_another_width_are_refused(network, name: str, head: str, width: int):
    tensors = on_meta(name).as_dict()
    for kind in ("weight", "bias"):
        shape = tensors[f"{head}.{kind}"].shape[1:]
        tensors[f"{head}.{kind}"] = torch.empty(width, *shape, device="meta")
    with pytest.raises(InputError, match=rf"output channels of {head}\.weight .*found {width}"):
        build_checked(network, Weights(tensors, name), SMALL)


def test_dinov2_and_fit3d_can_be_told_apart(tmp_path: Path, tensors):
    path = write(tmp_path / "fit3d.pth", tensors)
    assert load_network(FIT3D, path).dimension == 384
    with pytest.raises(InputError, match=r"expected a DINOv2 checkpoint, .*looks like FiT3D"):
        load_network(DINOV2, path)
