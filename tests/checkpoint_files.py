"""Checkpoint files as their makers publish them, filled by the rule of the stored outputs."""

from pathlib import Path

import torch
from torch import Tensor

from tests.priors.networks import rebuilt

ALEX = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}


def write(path: Path, content: object) -> Path:
    """Save the content of a checkpoint; return its path."""
    torch.save(content, path)
    return path


def tiny_fit3d() -> dict[str, Tensor]:
    """Return a FiT3D checkpoint whose blocks share one memory: quick to make, write and break."""
    shapes = rebuilt.shapes_of("fit3d_reg_small")
    other = [n for n in shapes if n.startswith("blocks.") and not n.startswith("blocks.0.")]
    tensors = rebuilt.tensors_of({n: s for n, s in shapes.items() if n not in other})
    return tensors | {n: tensors[f"blocks.0.{n.split('.', 2)[2]}"] for n in other}


def calm_droid() -> dict[str, Tensor]:
    """Return a DROID checkpoint that sees little motion: made-up weights would see far too much."""
    tensors = rebuilt.tensors_of(rebuilt.shapes_of("droid"))
    for kind in ("weight", "bias"):
        tensors[f"update.delta.2.{kind}"] = 0.01 * tensors[f"update.delta.2.{kind}"]
    return {f"module.{name}": tensor for name, tensor in tensors.items()}


def lpips_files() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the trunk, with a part that is of no use to LPIPS, and the heads."""
    trunk = {"classifier.6.bias": [1000]}
    for number, (out, into, side) in ALEX.items():
        trunk[f"features.{number}.weight"] = [out, into, side, side]
        trunk[f"features.{number}.bias"] = [out]
    heads = {f"lin{k}.model.1.weight": [1, v[0], 1, 1] for k, v in enumerate(ALEX.values())}
    return rebuilt.tensors_of(trunk), {n: t.abs() for n, t in rebuilt.tensors_of(heads).items()}


def write_all(folder: Path) -> Path:
    """Write the files of the paper's front-end and of LPIPS, each in its official layout."""
    folder.mkdir()
    network = {
        name: rebuilt.tensors_of(rebuilt.shapes_of(name))
        for name in ("fit3d_reg_small", "metric3d_vit_small", "depth_anything_v2_vits")
    }
    trunk, heads = lpips_files()
    contents = {
        "droid.pth": calm_droid(),
        "dinov2_reg_small_finetuned.pth": network["fit3d_reg_small"],
        "metric_depth_vit_small_800k.pth": {"model_state_dict": network["metric3d_vit_small"]},
        "depth_anything_v2_metric_hypersim_vits.pth": network["depth_anything_v2_vits"],
        "alexnet-owt-7be5be79.pth": trunk,
        "alex.pth": heads,
    }
    for name, content in contents.items():
        torch.save(content, folder / name)
    return folder
