"""Priors of other people and masks from files, through the command line."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from minislam.cli.main import main
from minislam.data.images import encode_png, read_mask
from minislam.data.run_folder import RunFolder

pytestmark = pytest.mark.slow

README = Path(__file__).parents[2] / "minislam/priors/networks/README.md"
CLIP = [
    "synth:ball", "--max-frames", "4", "--size", "112x84", "--preset", "test",
]  # fmt: skip
MODULE = """\
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow

def flow(device):
    return ClassicalFlow()

def features(device):
    return ClassicalFeatures()

def distance(device):
    return lambda frame, camera: frame.image
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Stand in a folder with a module of our own and the example of the README."""
    (tmp_path / "mine.py").write_text(MODULE)
    example = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)[1]
    assert len([line for line in example.splitlines() if line]) <= 15
    (tmp_path / "my_depth.py").write_text(example)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in ("mine", "my_depth"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module", autouse=True)
def cache(root: Path) -> Path:
    """Render the clip into a cache of these tests."""
    return root / "cache"


def test_flow_features_and_depth_of_others_run(here: Path):
    others = [
        "--flow", "python:mine:flow", "--features", "python:mine:features",
        "--depth", "python:my_depth:Floor",
    ]  # fmt: skip
    assert main(["run", *CLIP, *others, "-o", "out"]) in (0, 3)
    folder = RunFolder("out")
    assert folder.read_run()["priors"]["depth"] == "python:my_depth:Floor"
    warnings = folder.read_run()["warnings"]
    assert "without a depth prior the unit of length is arbitrary" not in warnings
    assert main(["priors", *CLIP, "--depth", "python:my_depth:Floor", "--out", "made"]) == 0
    depth = np.load(here / "made/depth/00003.npy")
    assert depth.shape == (84, 112) and depth[0, 0] == 0 < depth[-1, -1] < depth[60, 50]


def test_wrong_priors_are_one_sentence_and_nothing_is_written(here: Path, capsys):
    for name, words in (
        ("mine:distance", "to return a finite tensor (160, 224) torch.float32"),
        ("mine:nothing", "has no attribute 'nothing'"),
        ("none:make", "No module named 'none'"),
    ):
        assert main(["run", *CLIP, "--depth", f"python:{name}", "-o", "out"]) == 1
        said = [line for line in capsys.readouterr().err.splitlines() if "minislam:" in line]
        assert len(said) == 1 and said[0].startswith(f"minislam: expected --depth python:{name} ")
        assert words in said[0] and not (here / "out").exists()


def test_depth_of_another_recording_scale_or_precision_is_not_kept(here: Path, capsys):
    for name, depth in ("one", 2000), ("other", 4000):
        for kind, image in (
            ("rgb", np.random.default_rng(0).integers(30, 255, (48, 64, 3), np.uint8)),
            ("depth", np.full((48, 64), depth, np.uint16)),
        ):
            (here / name / kind).mkdir(parents=True)
            for stamp in "0.0", "0.1":
                (here / name / kind / f"{stamp}.png").write_bytes(encode_png(image))
    command = ["priors", "one", "--depth", "sensor", "--out", "made"]
    assert main(command) == main(command) == 0
    assert np.load("made/depth/00001.npy").max() == np.float32(2000 / 5000)
    other = ["priors", "other", *command[2:]]
    for changed in other, [*command, "--depth-scale", "1000"], [*command, "--precision", "bf16"]:
        assert main(changed) == 1
        assert "made/depth with other files; choose another --out" in capsys.readouterr().err


def test_masks_from_files_replace_the_learned_uncertainty(here: Path, cache, capsys):
    (here / "masks").mkdir()
    assert main(["run", *CLIP, "--masks", "files:masks", "-o", "out"]) == 1
    assert "found none for 4 of 4, such as " in capsys.readouterr().err
    images = sorted(next(cache.glob("**/rgb")).iterdir())
    for path in images:
        truth = read_mask(path.parent.parent / "masks" / path.name)
        truth[:, 100:] = True
        (here / "masks" / path.name).write_bytes(encode_png(truth.astype(np.uint8) * 255))
    assert main(["run", *CLIP, "--masks", "files:masks", "-o", "out"]) in (0, 3)
    config = json.loads((here / "out/config.json").read_text())
    assert config["input"]["masks"] == f"files:{here}/masks"
    assert config["uncertainty"]["given_masks"]
    assert RunFolder("out").read_metrics()["beta_auroc"] is None  # nothing was learned
    found = read_mask(next((here / "out/keyframes").glob("*_beta.png")))
    assert found[:, 104:].all() and not found[:, 60:96].all()
