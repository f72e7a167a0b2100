"""The paper's front-end from checkpoint files, through the command line.

The files have the official layout and made-up numbers: the results mean nothing, the way there is
the real one.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from minislam.cli.main import main
from minislam.data.ply import read_ply
from minislam.data.run_folder import RunFolder
from minislam.priors.networks.metric3d import Metric3DDepth
from minislam.priors.networks.vit import DinoFeatures
from tests.checkpoint_files import calm_droid, tiny_fit3d, write_all

pytestmark = pytest.mark.slow

FRAMES, SIZE = 8, "112x84"  # a grid of 11x14 cells for DROID, of 6x8 patches for the features
CLIP = ["synth:ball", "--max-frames", str(FRAMES), "--size", SIZE, "--preset", "test"]
FRONT_END = [
    "--flow", "droid", "--flow-weights", "droid.pth",
    "--features", "fit3d", "--features-weights", "dinov2_reg_small_finetuned.pth",
    "--depth", "metric3d", "--depth-weights", "metric_depth_vit_small_800k.pth",
    "--lpips-trunk", "alexnet-owt-7be5be79.pth", "--lpips-heads", "alex.pth",
]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def cache(root: Path) -> Path:
    """Render the clips into a cache of these tests."""
    return root / "cache"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the checkpoints."""
    return write_all(tmp_path_factory.mktemp("networks") / "weights")


def located(files: Path, arguments: list[str]) -> list[str]:
    """Return arguments with the names of checkpoints as paths."""
    return [str(files / a) if a.endswith(".pth") else a for a in arguments]


def the_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("minislam: ")]
    assert len(said) == 1 and "Traceback" not in "".join(lines), lines
    return said[0]


# The whole road


def test_the_papers_front_end_runs_from_its_checkpoint_files(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    seen: dict[str, list[int]] = {"DinoFeatures": [], "Metric3DDepth": []}  # frames it was asked
    for network in (DinoFeatures, Metric3DDepth):
        inner = network.__call__

        def recorded(self, frame, *more, inner=inner, frames=seen[network.__name__]):
            frames.append(frame.frame_index)
            return inner(self, frame, *more)

        monkeypatch.setattr(network, "__call__", recorded)
    out = tmp_path / "out"
    more = ["--tracking.keyframe_interval", "2", "-o", str(out)]
    # Networks with random weights: the run may rightly say that its trajectory is broken (3).
    assert main(["run", *CLIP, *located(files, FRONT_END), *more]) in (0, 3)

    folder = RunFolder(out)
    facts, metrics = folder.read_run(), folder.read_metrics()
    assert facts["priors"]["flow"] == "droid" and facts["frames"] == FRAMES
    assert facts["keyframes"] >= 4
    # Once per frame at most, the check of the features' file on a blank image left aside, and once
    # more for the clip.
    features, depths = seen["DinoFeatures"], seen["Metric3DDepth"]
    assert facts["keyframes"] <= len(features) <= 2 * FRAMES + 2
    assert max(features.count(frame) for frame in range(1, FRAMES)) <= 2
    assert len(set(depths)) == len(depths) == facts["keyframes"]
    assert "without a depth prior the unit of length is arbitrary" not in facts["warnings"]
    assert metrics["lpips_novel"] > 0 and metrics["lpips_input"] > 0
    assert np.isfinite(folder.read_trajectory().T_world_camera).all()
    assert any(
        tensor.shape[-1] == 384
        for tensor in torch.load(folder.path / "uncertainty_mlp.pt", weights_only=True).values()
    )
    # Measured: 93. Depth and features of random weights agree on little.
    assert len(read_ply(folder.path / "map.ply").means) > 50


def test_the_paper_preset_runs_on_its_networks(files: Path, tmp_path: Path):
    out, few = tmp_path / "out", ["--max-frames", "5", "--tracking.keyframe_interval", "2"]
    for name, count in ("init", 8), ("keyframe", 2), ("refine", 8):  # of some 20,000
        few += [f"--mapping.{name}_iterations", str(count)]
    clip = ["synth:ball", "--size", SIZE, "--preset", "paper", "-o", str(out)]
    assert main(["run", *clip, *few, *located(files, FRONT_END[:12])]) in (0, 3)
    folder = RunFolder(out)
    assert folder.read_run()["frames"] == 5
    assert np.isfinite(folder.read_trajectory().T_world_camera).all()
    assert len(read_ply(folder.path / "map.ply").means) > 100


def test_priors_written_to_files_give_the_same_run(files: Path, tmp_path: Path, capsys):
    clip = ["synth:ball", "--size", SIZE, "--preset", "test"]
    every, second = ["--max-frames", "6"], ["--stride", "2", "--max-frames", "3"]
    priors = located(files, FRONT_END[4:12])
    made = tmp_path / "my priors"
    assert main(["priors", *clip, *every, *priors, "--out", str(made)]) == 0
    said = capsys.readouterr()
    assert f"--features 'files:{made}' --depth 'files:{made}'" in said.out
    assert "writing features: 6/6" in said.err and "writing depth: 6/6" in said.err
    assert len(list(made.glob("features/*.npy"))) == len(list(made.glob("depth/*.npy"))) == 6
    assert np.load(made / "features/00005.npy").shape == (6, 8, 384)
    assert np.load(made / "depth/00005.npy").shape == (84, 112)
    assert not list(made.rglob("*.tmp"))

    from_files = ["--features", f"files:{made}", "--depth", f"files:{made / 'depth'}"]
    for out, chosen in (("direct", priors), ("read", from_files)):
        assert main(["run", *clip, *second, *chosen, "-o", str(tmp_path / out)]) in (0, 3)
    # Every second frame only, so the files were found by their moments, not by their numbers.
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "direct" / name).read_bytes() == (tmp_path / "read" / name).read_bytes()


def test_depth_anything_and_a_png_folder_are_depth_as_well(files: Path, tmp_path: Path):
    clip = ["synth:ball", "--max-frames", "4", "--size", SIZE, "--preset", "test"]
    weights = files / "depth_anything_v2_metric_hypersim_vits.pth"
    chosen = ["--depth", "depth-anything", "--depth-weights", str(weights)]
    assert main(["run", *clip, *chosen, "-o", str(tmp_path / "out")]) in (0, 3)
    for number in range(4):
        millimetres = np.full((84, 112), 3000, np.uint16)
        (tmp_path / "png").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"png/{number}.png"), millimetres)
    chosen = ["--depth", f"files:{tmp_path / 'png'}", "--depth-scale", "1000"]
    assert main(["priors", *clip, *chosen, "--out", str(tmp_path / "made")]) == 0
    np.testing.assert_allclose(np.load(tmp_path / "made/depth/00003.npy"), 3, rtol=1e-6)


# minislam priors


def test_what_is_written_is_not_made_again_and_other_files_are_left_alone(tmp_path: Path, capsys):
    command = ["priors", *CLIP, "--features", "classical", "--out", str(tmp_path / "made")]
    assert main(command) == 0
    folder = tmp_path / "made/features"
    whole = (folder / "00004.npy").read_bytes()
    (folder / "00003.npy").write_bytes(b"mine")
    (folder / "00004.npy").unlink()
    assert main(command) == 0
    assert (folder / "00003.npy").read_bytes() == b"mine"
    assert (folder / "00004.npy").read_bytes() == whole
    capsys.readouterr()
    assert main([*command, "--fx", "99"]) == 1
    assert "one of the same command" in the_sentence(capsys)
    (tmp_path / "other/features").mkdir(parents=True)
    (tmp_path / "other/features/notes.txt").write_text("mine")
    assert main([*command[:-1], str(tmp_path / "other")]) == 1
    assert "other/features with other files" in the_sentence(capsys)
    (tmp_path / "file").write_text("x")
    assert main([*command[:-1], str(tmp_path / "file")]) == 1
    assert "file is a file; choose another name" in the_sentence(capsys)


# Errors


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of small files, each wrong in its own way."""
    folder = tmp_path_factory.mktemp("broken")
    fit3d, droid = tiny_fit3d(), calm_droid()
    torch.save(droid, folder / "droid.pth")
    torch.save(fit3d, folder / "fit3d.pth")
    whole = (folder / "droid.pth").read_bytes()
    (folder / "truncated.pth").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.pth").write_bytes(b"")
    torch.save({n: t for n, t in droid.items() if "convq." not in n}, folder / "lacking.pth")
    torch.save({**fit3d, "norm.weight": torch.zeros(768)}, folder / "other_size.pth")
    giant = {**fit3d, "patch_embed.proj.weight": torch.ones(1536, 1)}
    torch.save(giant, folder / "giant.pth")
    torch.save(
        {f"pretrained.{n}": t for n, t in fit3d.items()}
        | {"depth_head.scratch.output_conv1.weight": torch.ones(1)},
        folder / "depth_anything_v2_metric_hypersim_vits.pth",
    )
    return folder


ERRORS = [
    (["--flow", "droid"], "expected --flow-weights FILE with --flow droid, found none"),
    (["--features", "fit3d"], "expected --features-weights FILE with --features fit3d"),
    (["--depth", "metric3d"], "expected --depth-weights FILE with --depth metric3d"),
    (["--flow-weights", "droid.pth"], "expected --flow droid with --flow-weights, found --flow cl"),
    (["--features-weights", "fit3d.pth"], "expected --features dinov2 or fit3d with --features-we"),
    (["--flow", "raft"], "expected --flow classical, droid or python:MODULE:"),
    (["--features", "clip"], "expected --features classical, files:FOLDER, dinov2, fit3d"),
    (["--depth", "laser"], "expected --depth none, simulated, sensor, files:FOLDER, metric3d"),
    (["--device", "tpu"], "expected --device cpu or cuda, found 'tpu'"),
    (["--flow", "droid", "--flow-weights", "none.pth"], "found nothing at"),
    (["--flow", "droid", "--flow-weights", "truncated.pth"], "which cannot be read as one"),
    (["--flow", "droid", "--flow-weights", "empty.pth"], "(0 bytes), which cannot be read as one"),
    (["--flow", "droid", "--flow-weights", "lacking.pth"], "the tensor update.gru.convq.weight"),
    (["--flow", "droid", "--flow-weights", "fit3d.pth"], "which looks like FiT3D (ViT of width"),
    (["--features", "fit3d", "--features-weights", "droid.pth"], "which looks like DROID-SLAM"),
    (["--features", "dinov2", "--features-weights", "fit3d.pth"], "expected a DINOv2 checkpoint"),
    (["--features", "fit3d", "--features-weights", "other_size.pth"], "do not fit together"),
    (["--features", "fit3d", "--features-weights", "giant.pth"], "one of width 1536"),
    (["--depth", "metric3d", "--depth-weights", "fit3d.pth"], "which looks like FiT3D"),
    (["--depth", "depth-anything", "--depth-weights",
      "depth_anything_v2_metric_hypersim_vits.pth"], "the tensor depth_head.projects.0.w"),
    (["--features", "files:nowhere"], "expected a folder of features files, found nothing at"),
    (["--lpips-trunk", "fit3d.pth"], "expected --lpips-heads FILE with --lpips-trunk, found none"),
    (["--lpips-trunk", "fit3d.pth", "--lpips-heads", "droid.pth"], "AlexNet or VGG-16 for LPIPS"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), ERRORS, ids=[words[:40] for _, words in ERRORS])
def test_a_wrong_prior_is_one_sentence_and_exit_code_1(
    arguments: list[str], words: str, files: Path, broken: Path, tmp_path: Path, capsys
):
    assert main(["run", *CLIP, *located(broken, arguments), "-o", str(tmp_path / "out")]) == 1
    assert words in the_sentence(capsys)
    assert not (tmp_path / "out").exists()  # an earlier run would still be there


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_one_sentence(files: Path, tmp_path: Path, capsys):
    arguments = ["--flow", "droid", "--flow-weights", "droid.pth", "--device", "cuda"]
    assert main(["run", *CLIP, *located(files, arguments), "-o", str(tmp_path / "out")]) == 1
    assert "expected a GPU that this torch can use for --device cuda" in the_sentence(capsys)


def test_images_too_small_for_droid_end_the_run_in_one_sentence(
    files: Path, tmp_path: Path, capsys
):
    small = ["run", "synth:ball", "--max-frames", "4", "--size", "64x48", "--preset", "test"]
    chosen = located(files, FRONT_END[:4])
    assert main([*small, *chosen, "-o", str(tmp_path / "out")]) == 1
    assert "expected images of more than 56 px per side for DROID" in the_sentence(capsys)
    facts = json.loads((tmp_path / "out/run.json").read_text())
    assert facts["state"].startswith("failed: expected images of more than 56 px")


def test_priors_without_anything_to_write_and_files_of_another_sequence(
    files: Path, tmp_path: Path, capsys
):
    made = str(tmp_path / "made")
    assert main(["priors", *CLIP, "--out", made]) == 1
    assert "expected --features or --depth, found neither" in the_sentence(capsys)
    short = ["synth:ball", "--max-frames", "3", "--size", SIZE, "--preset", "test"]
    assert main(["priors", *short, "--features", "classical", "--out", made]) == 0
    file = tmp_path / "choice.json"  # may name them as well
    file.write_text(json.dumps({"priors": {"features": f"files:{made}"}}))
    assert main(["priors", *short, "--config", str(file), "--out", str(tmp_path / "again")]) == 0
    assert len(list((tmp_path / "again/features").glob("*.npy"))) == 3
    capsys.readouterr()
    taken = ["--features", f"files:{made}", "-o", str(tmp_path / "out")]
    assert main(["run", *CLIP, *taken]) == 1
    assert "8 files, found 3" in the_sentence(capsys) and not (tmp_path / "out").exists()
    assert main(["run", *short, "--stride", "2", *taken]) == 1
    assert "found no such frame in" in the_sentence(capsys)


def test_a_finer_grid_is_made_with_the_network_not_from_files(tmp_path: Path, capsys):
    short = ["synth:ball", "--max-frames", "3", "--size", SIZE, "--preset", "test"]
    finer = ["--uncertainty.grid_factor", "2"]
    made = ["--out", str(tmp_path / "made")]
    assert main(["priors", *short, "--features", "classical", *finer, *made]) == 0
    assert np.load(tmp_path / "made/features/00000.npy").shape[:2] == (24, 32)
    assert main(["run", *short, "--features", f"files:{tmp_path / 'made'}", *finer]) == 1
    assert "give the factor to minislam priors" in the_sentence(capsys)
