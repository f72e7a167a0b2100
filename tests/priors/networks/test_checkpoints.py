"""Checkpoint files: official containers are read, everything else is refused in one sentence."""

import argparse
from pathlib import Path

import numpy as np
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
        lambda t: {f"_orig_mod.{n}": v for n, v in t.items()},
        lambda t: {f"module._orig_mod.{n}": v for n, v in t.items()},
        lambda t: {f"model.{n}": v for n, v in t.items()} | {"loss.weight": torch.ones(2)},
        lambda t: {"model": {"state_dict": {f"_orig_mod.module.{n}": v for n, v in t.items()}}},
        lambda t: {"state_dict": {"model": t}, "epoch": torch.tensor(3)},
        lambda t: {"teacher": t, "student": {n: v + 1 for n, v in t.items()}},
        lambda t: {"net": t},
        lambda t: {"model_ema": {n: v.double() for n, v in t.items()}},
    ],
)
def test_containers_and_prefixes_in_any_order_are_the_same_file(tmp_path: Path, tensors, wrap):
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


def test_files_that_are_no_checkpoints_are_refused(tmp_path: Path, tensors):
    (tmp_path / "text.pth").write_text("hello")
    (tmp_path / "empty.pth").write_bytes(b"")
    whole = write(tmp_path / "whole.pth", tensors).read_bytes()
    (tmp_path / "truncated.pth").write_bytes(whole[: len(whole) // 2])
    circle: dict = {}
    circle["model"] = circle
    write(tmp_path / "circle.pth", circle)
    for name in ("text", "empty", "truncated", "circle"):
        with pytest.raises(InputError, match=rf"{name}\.pth .*cannot be read") as caught:
            load_checkpoint(tmp_path / f"{name}.pth")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("legacy", [False, True])
def test_objects_in_a_file_are_named_and_never_executed(tmp_path: Path, tensors, legacy: bool):
    contents = {
        "run_code": Hostile(),
        "torch.nn.modules.linear.Linear": torch.nn.Linear(1, 1),
        "argparse.Namespace": {"model": tensors, "args": argparse.Namespace(epochs=3)},
        "scalar": {"model": tensors, "best": np.float64(0.5)},
    }
    for name, content in contents.items():
        torch.save(content, tmp_path / "w.pth", _use_new_zipfile_serialization=not legacy)
        with pytest.raises(
            InputError, match=rf"which holds a .*{name}, .* weights_only=True"
        ) as it:
            load_checkpoint(tmp_path / "w.pth")
        assert "\n" not in str(it.value) and "download" not in str(it.value)


def test_a_file_without_tensors_says_what_it_holds(tmp_path: Path):
    contents = {
        r"the entries \[\]": {},
        r"the entries \['epoch'\]": {"epoch": 3},
        "<class 'list'>": [1, 2],
        "<class 'torch.Tensor'>": torch.zeros(3),
        r"the entries \['weights', 'epoch'\]": {"weights": {"a.x": torch.ones(1)}, "epoch": 3},
    }
    for found, content in contents.items():
        with pytest.raises(InputError, match=f"named tensors in .*, found {found}; give"):
            load_checkpoint(write(tmp_path / "w.pth", content))


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        (lambda t: t | {"norm.bias": t["norm.bias"] / 0 * 0}, "NaN or infinity in norm.bias"),
        (lambda t: t | {"norm.bias": t["norm.bias"] / 0}, "NaN or infinity in norm.bias"),
        (lambda t: {n: v * 0 for n, v in t.items()}, "175 of 175 tensors that are zero"),
        (lambda t: {n: (99 * v).to(torch.int8) for n, v in t.items()}, "torch.int8 in "),
    ],
)
def test_numbers_that_are_no_trained_weights_are_refused(tmp_path: Path, tensors, damage, found):
    with pytest.raises(InputError, match=found):
        load_checkpoint(write(tmp_path / "w.pth", damage(tensors)))
