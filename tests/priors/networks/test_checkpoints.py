"""Checkpoint files: official containers are read, everything else is refused in one sentence."""

from pathlib import Path

import pytest
import torch

from minislam.errors import InputError
from minislam.priors.networks.checkpoints import Weights, describe, load_checkpoint
from minislam.priors.networks.dinov2 import load_dino_features
from tests.checkpoint_files import tiny_fit3d
from tests.helpers import frame_of
from tests.priors.networks import rebuilt


@pytest.fixture(scope="module")
def tensors() -> dict[str, torch.Tensor]:
    return tiny_fit3d()


def write(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


# Known answers


def test_the_rule_of_the_rebuilt_weights_gives_the_published_values():
    noise = rebuilt.noise("pos_embed", 2)
    assert noise.tolist() == [0.7505072355270386, -0.8357263803482056]
    gamma = rebuilt.parameter_values("blocks.0.ls1.gamma", [384])
    assert [float(g) for g in gamma[:2]] == [0.5380743741989136, 0.5252122282981873]


@pytest.mark.parametrize(
    "wrap",
    [
        lambda t: t,
        lambda t: {"model_state_dict": t, "optimizer": {}, "epoch": 3},
        lambda t: {"state_dict": {f"module.{n}": v for n, v in t.items()}},
    ],
)
def test_flat_wrapped_and_data_parallel_files_are_the_same(tmp_path: Path, tensors, wrap):
    weights = load_checkpoint(write(tmp_path / "w.pth", wrap(tensors)))
    assert sorted(weights) == sorted(tensors)
    assert torch.equal(weights["norm.weight"], tensors["norm.weight"])


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ("dinov2_vits14", "DINOv2 (ViT of width 384, no registers)"),
        ("dinov2_vits14_reg", "DINOv2 (ViT of width 384, with registers)"),
        ("fit3d_small", "FiT3D (ViT of width 384, no registers)"),
        ("fit3d_reg_small", "FiT3D (ViT of width 384, with registers)"),
        ("depth_anything_v2_vitl", "Depth Anything V2 (ViT of width 1024)"),
        ("metric3d_vit_large", "Metric3D v2 (ViT of width 1024)"),
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
    features = load_dino_features(write(tmp_path / "w.pth", tensors))
    assert features(frame_of(torch.zeros(28, 42, 3))).shape == (2, 3, 384)


def test_parts_share_what_has_been_used():
    weights = Weights({"a.x.weight": torch.zeros(1), "a.y.weight": torch.zeros(1)}, "f")
    part = weights.below("a.")
    assert sorted(part) == ["x.weight", "y.weight"] and "x.weight" in part
    assert list(part.as_dict()) == ["x.weight", "y.weight"]
    part.below("x.")["weight"]
    assert weights.unused() == ["a.y.weight"]


# Errors


def run_code() -> None:
    raise AssertionError("a checkpoint was executed")


class Hostile:
    def __reduce__(self):
        return run_code, ()


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"found nothing at .*none\.pth"):
        load_checkpoint(tmp_path / "none.pth")


def test_files_that_are_no_checkpoints_are_refused_and_never_executed(tmp_path: Path, tensors):
    (tmp_path / "text.pth").write_text("hello")
    (tmp_path / "empty.pth").write_bytes(b"")
    whole = write(tmp_path / "whole.pth", tensors).read_bytes()
    (tmp_path / "truncated.pth").write_bytes(whole[: len(whole) // 2])
    write(tmp_path / "hostile.pth", Hostile())
    for name in ("text", "empty", "truncated", "hostile"):
        with pytest.raises(InputError, match=rf"{name}\.pth .*cannot be read") as caught:
            load_checkpoint(tmp_path / f"{name}.pth")
        assert "\n" not in str(caught.value)


def test_a_file_without_tensors_is_refused(tmp_path: Path):
    for content in ({}, {"epoch": 3}, [1, 2], torch.zeros(3)):
        with pytest.raises(InputError, match="named tensors"):
            load_checkpoint(write(tmp_path / "w.pth", content))


def test_another_network_is_named(tmp_path: Path):
    path = write(tmp_path / "droid.pth", {"module.update.gru.convz.weight": torch.zeros(1)})
    sentence = r"expected a DINOv2 or FiT3D checkpoint, found .*droid\.pth, which looks like DROID"
    with pytest.raises(InputError, match=sentence):
        load_dino_features(path)


def test_missing_unexpected_and_misshapen_tensors_are_named(tmp_path: Path, tensors):
    missing = {n: t for n, t in tensors.items() if n != "blocks.1.mlp.fc2.weight"}
    with pytest.raises(InputError, match=r"expected the tensor blocks\.1\.mlp\.fc2\.weight"):
        load_dino_features(write(tmp_path / "a.pth", missing))
    extra = {**tensors, "blocks.0.attn.lora": torch.zeros(1)}
    with pytest.raises(InputError, match=r"found 1 more, such as blocks\.0\.attn\.lora"):
        load_dino_features(write(tmp_path / "b.pth", extra))
    misshapen = {**tensors, "blocks.0.mlp.fc1.weight": torch.zeros(1536, 383)}
    with pytest.raises(InputError, match="do not fit together"):
        load_dino_features(write(tmp_path / "c.pth", misshapen))
    misshapen = {**tensors, "cls_token": torch.zeros(1, 1, 12)}
    with pytest.raises(InputError, match="do not fit together"):
        load_dino_features(write(tmp_path / "d.pth", misshapen))


def test_dinov2_and_fit3d_can_be_told_apart(tmp_path: Path, tensors):
    path = write(tmp_path / "fit3d.pth", tensors)
    assert load_dino_features(path, kind="FiT3D").dimension == 384
    with pytest.raises(InputError, match=r"expected a DINOv2 checkpoint, .*looks like FiT3D"):
        load_dino_features(path, kind="DINOv2")
