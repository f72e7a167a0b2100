"""Checkpoint files: official containers are read, everything else is refused in one sentence."""

from pathlib import Path

import pytest
import torch

from minislam.errors import InputError
from minislam.priors.networks.checkpoints import Weights, load_checkpoint
from tests.checkpoint_files import tiny_fit3d, write
from tests.priors.networks import rebuilt


@pytest.fixture(scope="module")
def tensors() -> dict[str, torch.Tensor]:
    return tiny_fit3d()


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


# Identities


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
