"""Doctor names what lies in a folder of checkpoints, and what is wrong with it."""

from pathlib import Path

import pytest
import torch

from minislam.cli.main import main
from tests.checkpoint_files import lpips_files, tiny_fit3d, write_all

pytestmark = pytest.mark.slow


def lines_of(folder: Path, capsys) -> dict[str, str]:
    assert main(["doctor", "--weights", str(folder)]) == 0
    rows = capsys.readouterr().out.splitlines()
    return {row.split()[0]: row for row in rows}


def test_every_file_is_recognised_with_its_size_and_its_flag(tmp_path: Path, capsys):
    lines = lines_of(write_all(tmp_path / "weights"), capsys)
    assert {name: line.split("MB  ")[1] for name, line in lines.items()} == {
        "alex.pth": "LPIPS linear weights, complete: --lpips-heads",
        "alexnet-owt-7be5be79.pth": (
            "an image classifier of torchvision, complete: --lpips-trunk"
        ),
        "depth_anything_v2_metric_hypersim_vits.pth": (
            "Depth Anything V2 (ViT of width 384, no registers), complete: "
            "--depth depth-anything --depth-weights"
        ),
        "dinov2_reg_small_finetuned.pth": (
            "FiT3D (ViT of width 384, with registers), complete: "
            "--features fit3d --features-weights"
        ),
        "droid.pth": "DROID-SLAM, complete: --flow droid --flow-weights",
        "metric_depth_vit_small_800k.pth": (
            "Metric3D v2 (ViT of width 384, with registers), complete: "
            "--depth metric3d --depth-weights"
        ),
    }  # fmt: skip
    size = (tmp_path / "weights/droid.pth").stat().st_size / 1e6
    assert f" {size:.1f} MB " in lines["droid.pth"]


def test_what_is_broken_or_foreign_is_said_on_its_line(tmp_path: Path, capsys):
    fit3d, (trunk, heads) = tiny_fit3d(), lpips_files()
    torch.save(fit3d, tmp_path / "whole.pth")
    whole = (tmp_path / "whole.pth").read_bytes()
    (tmp_path / "half.pth").write_bytes(whole[: len(whole) // 2])
    torch.save({n: t for n, t in fit3d.items() if n != "norm.bias"}, tmp_path / "lacking.pth")
    torch.save({n: t for n, t in trunk.items() if ".10." not in n}, tmp_path / "trunk.pt")
    torch.save({n: t for n, t in heads.items() if "lin4" not in n}, tmp_path / "heads.pt")
    torch.save({"anything": torch.ones(2)}, tmp_path / "other.pth")
    (tmp_path / "notes.txt").write_text("not a checkpoint")
    lines = lines_of(tmp_path, capsys)
    assert set(lines) == {
        "half.pth", "heads.pt", "lacking.pth", "other.pth", "trunk.pt", "whole.pth"
    }  # fmt: skip
    assert "unreadable: expected a PyTorch checkpoint" in lines["half.pth"]
    assert "NOT usable: expected the tensor norm.bias" in lines["lacking.pth"]
    assert "NOT usable: expected features.10.weight of AlexNet" in lines["trunk.pt"]
    assert "NOT usable: expected five LPIPS heads" in lines["heads.pt"]
    assert "something unknown (1 tensors, the first is anything), of no use" in lines["other.pth"]
    assert lines["whole.pth"].endswith("complete: --features fit3d --features-weights")


def test_a_folder_without_checkpoints_is_one_sentence(tmp_path: Path, capsys):
    for folder in (tmp_path, tmp_path / "nowhere"):
        assert main(["doctor", "--weights", str(folder)]) == 1
        said = capsys.readouterr().err
        assert said.startswith("minislam: expected a folder with checkpoint files")
        assert said.count("\n") == 1
