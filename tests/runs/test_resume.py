"""A run that was interrupted anywhere goes on to the files of one that was not, byte by byte."""

import json
import re
import shutil
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

import minislam
from minislam.cli.main import main
from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.data.run_folder import RunFolder
from minislam.runs.progress import ProgressLine

pytestmark = pytest.mark.slow

FRAMES = 13
INPUT = ["--stride", "3", "--max-frames", str(FRAMES), "--size", "96x72"]
SETTINGS = [
    "--preset", "test", "--mapping.init_iterations", "8", "--mapping.keyframe_iterations", "2",
    "--mapping.refine_iterations", "8", "--mapping.pose_refinement.enabled", "on",
]  # fmt: skip
SAME = ("trajectory.txt", "keyframe_trajectory.txt", "lost_frames.txt", "map.ply", "config.json")
OF_TIME = ("seconds_total", "frames_per_second", "peak_memory_mb")  # all that may differ
TRACKING = "tracking and mapping"  # initialised at frame 8


class PowerCut(BaseException):
    """Nothing is written any more."""


def power_cut() -> None:
    raise PowerCut


ctrl_c = partial(signal.raise_signal, signal.SIGINT)


def run(source: object, out: Path, *more: str, inputs: list[str] = INPUT) -> int:
    return main(["run", str(source), *inputs, *SETTINGS, "-o", str(out), *more])


def run_until(
    event: Callable[[], None], stage: str, step: int, source: object, out: Path, *more: str
):
    """Run, and let an event happen when a step of a stage is reported."""
    usual = ProgressLine.show

    def show(line: ProgressLine, name: str, done: int, total: int) -> None:
        usual(line, name, done, total)
        if (name, done) == (stage, step):
            event()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ProgressLine, "show", show)
        patch.setattr("minislam.slam.FRAMES_AT_ONCE", 2)
        return run(source, out, *more)


@pytest.fixture(scope="module")
def whole(root: Path) -> Path:
    assert run("synth:person", root / "whole") == 0
    return root / "whole"


def assert_same_results(whole: Path, out: Path, names: tuple[str, ...] = SAME) -> None:
    for name in names:
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    runs = [RunFolder(path) for path in (whole, out)]
    expected, found = (folder.read_metrics() for folder in runs)
    assert {name for name in expected if expected[name] != found[name]} <= set(OF_TIME)
    expected, found = (
        torch.load(folder.path / "uncertainty_mlp.pt", weights_only=True) for folder in runs
    )
    assert all(bool((expected[name] == found[name]).all()) for name in expected)
    expected, found = (folder.read_run() for folder in runs)
    assert all(found[name] == expected[name] for name in ("keyframe_diagnostics", "state"))
    assert list(found["seconds"]) == list(expected["seconds"])
    pictures = sorted(path.name for path in (whole / "keyframes").iterdir())
    assert sorted(path.name for path in (out / "keyframes").iterdir()) == pictures


# The same bytes


def test_a_run_interrupted_in_every_stage_goes_on_to_the_same_bytes(whole: Path, root: Path):
    out, again = root / "often", []
    for number, stage, step in [
        (signal.SIGINT, TRACKING, 2),  # Ctrl-C
        (signal.SIGTERM, TRACKING, 11),
        (signal.SIGHUP, TRACKING, FRAMES),
        (signal.SIGINT, "refining the map", 8),
        (signal.SIGTERM, "refining the poses", 2),
    ]:
        event = partial(signal.raise_signal, number)
        assert run_until(event, stage, step, "synth:person", out, *again) == 130
        assert RunFolder(out).read_run()["state"] == "interrupted"
        again = ["--resume", "--workers", "2" if step in (FRAMES, 8) else "1"]
    before = RunFolder(out).read_run()["seconds"]
    assert run("synth:person", out, "--resume") == 0
    assert_same_results(whole, out)
    after = RunFolder(out).read_run()["seconds"]
    assert after["tracking"] == before["tracking"] and after["total"] > sum(before.values()) / 2


@pytest.mark.parametrize("step", [5, 10])
def test_after_a_power_cut_the_last_checkpoint_serves(step: int, whole: Path, root: Path):
    out = root / f"cut{step}"
    often = ("--checkpoint_fraction", "1e9")  # one after every step
    with pytest.raises(PowerCut):
        run_until(power_cut, TRACKING, step, "synth:person", out, *often)
    assert RunFolder(out).read_run()["state"] == "running"
    state = read_checkpoint(out / "checkpoint.npz")["slam"]
    assert state["steps"]["_done"] == {TRACKING: step - 1}
    (out / "keyframes/000099_beta.png").touch()  # of a keyframe that was given up
    assert run("synth:person", out, "--resume", *often) == 0
    assert_same_results(whole, out, SAME[:-1])


@pytest.fixture(scope="module")
def photos(whole: Path, root: Path) -> Path:
    """Return a folder of photos, about which nothing else is known."""
    found = sorted((root / "cache").rglob("rgb/*.png"))[: 3 * FRAMES : 3]
    (root / "photos").mkdir()
    for number, path in enumerate(found):
        shutil.copy(path, root / "photos" / f"{number:02d}.png")
    return root / "photos"


def test_without_a_depth_prior_after_a_damaged_image_was_replaced(photos: Path, root: Path, capsys):
    inputs = ["--fx", "75", "--focal", "refine"]
    assert run(photos, root / "photos_whole", inputs=inputs) == 0
    assert RunFolder(root / "photos_whole").read_run()["camera"]["fx"] != 75
    content = (photos / "12.png").read_bytes()
    (photos / "12.png").write_bytes(content[:300])
    assert run(photos, root / "photos_broken", inputs=inputs) == 1
    assert "12.png (300 bytes) is damaged" in capsys.readouterr().err
    (photos / "12.png").write_bytes(content)
    state = read_checkpoint(root / "photos_broken/checkpoint.npz")["slam"]
    assert state["steps"]["_done"] == {TRACKING: 12}
    assert run(photos, root / "photos_broken", "--resume", "--k1", "-.3", inputs=inputs) == 1
    assert_one_sentence("expected frame 0 as the interrupted run .* found another image", capsys)
    assert run(photos, root / "photos_broken", "--resume", inputs=inputs) == 0
    assert_same_results(root / "photos_whole", root / "photos_broken")


def test_sequence_input_and_settings_come_from_the_folder(whole: Path, root: Path):
    out = root / "short"
    assert run_until(ctrl_c, TRACKING, 3, "synth:person", out) == 130
    assert main(["run", "-o", str(out), "--resume"]) == 0
    assert_same_results(whole, out)


def test_what_a_gpu_began_goes_on_on_a_cpu(interrupted: Path, tmp_path: Path, monkeypatch, capsys):
    out = shutil.copytree(interrupted, tmp_path / "out")
    tree = read_checkpoint(out / "checkpoint.npz")
    tree["priors"] |= {"device": "cuda", "precision": "fp16"}
    write_checkpoint(out / "checkpoint.npz", tree)
    with np.load(out / "checkpoint.npz") as file:
        arrays = dict(file)
    text = arrays["tree.json"].tobytes().replace(b'"cpu"]', b'"cuda:0"]')
    np.savez(out / "checkpoint.npz", **arrays | {"tree.json": np.frombuffer(text, np.uint8)})
    config = (out / "config.json").read_text().replace('"device": "cpu"', '"device": "cuda"')
    (out / "config.json").write_text(config.replace('"fp32"', '"fp16"'))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["run", "-o", str(out), "--resume"]) == 1
    assert_one_sentence("expected a GPU .* found none; say --device cpu", capsys)
    assert main(["run", "-o", str(out), "--resume", "--device", "cpu"]) == 1
    assert_one_sentence("--precision fp32 or bf16 with --device cpu, found 'fp16'", capsys)
    again = ("--resume", "--device", "cpu", "--precision", "fp32")
    assert run_until(ctrl_c, TRACKING, 4, "synth:person", out, *again) == 130
    state = read_checkpoint(out / "checkpoint.npz")
    assert state["priors"]["device"] == "cpu" and state["slam"]["steps"]["_done"] == {TRACKING: 4}


def test_a_finished_run_keeps_no_checkpoint(whole: Path, capsys):
    assert not (whole / "checkpoint.npz").exists()
    assert run("synth:person", whole, "--resume") == 1
    assert_one_sentence("found no checkpoint.npz, as in a finished run; see report.html", capsys)


# What is refused, and costs nothing


@pytest.fixture(scope="module")
def interrupted(whole: Path, root: Path) -> Path:
    out = root / "interrupted"
    assert run_until(ctrl_c, TRACKING, 2, "synth:person", out) == 130
    return out


REFUSALS = [
    (
        ["--stride", "1", "--max-frames", "39", *INPUT[4:]],  # the same frames are rendered
        "expected input.stride = 3 like .* found 1; repeat",
    ),
    ([*INPUT, "--fx", "99"], "expected input.fx = None like .* found 99.0; repeat"),
    ([*INPUT, "--focal", "refine"], "expected input.focal = auto .* found refine"),
    ([*INPUT, "--depth-scale", "9"], "expected input.depth_scale = 5000.0 .* found 9.0"),
    ([*INPUT, "--depth", "none"], "expected priors.depth = simulated .* found none"),
    ([*INPUT, "--tracking.window", "3"], "settings.tracking.window = 10 .* found 3; repeat"),
    ([*INPUT, "--seed", "7"], "expected settings.seed = 0 .* found 7"),
    ([*INPUT, "--preset", "laptop"], "settings.tracking.warmup_rounds = 1 .* found 3"),
    ([*INPUT, "--no-uncertainty"], "expected settings.uncertainty.enabled = True .* found False"),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSALS, ids=[words for _, words in REFUSALS])
def test_another_run_is_refused(arguments: list[str], words: str, interrupted: Path, capsys):
    before = contents(interrupted)
    assert main(["run", "synth:person", *arguments, "-o", str(interrupted), "--resume"]) == 1
    assert_one_sentence(words, capsys)
    assert contents(interrupted) == before


def remove(name: str, folder: Path) -> None:
    (folder / name).unlink()


def truncate(folder: Path) -> None:
    content = (folder / "checkpoint.npz").read_bytes()
    (folder / "checkpoint.npz").write_bytes(content[: len(content) // 2])


def grow_older(folder: Path) -> None:
    tamper(lambda tree: tree.update(version="0.0", input={}), folder)


def change_an_image(folder: Path) -> None:
    tamper(lambda tree: tree["checksums"].update({"1": 0}), folder)


def tamper(change: Callable[[dict], object], folder: Path) -> None:
    tree = read_checkpoint(folder / "checkpoint.npz")
    change(tree)
    write_checkpoint(folder / "checkpoint.npz", tree or [1, 2])


TAMPERED: list[Callable[[dict], object]] = [
    dict.clear,
    lambda tree: [tree.pop("slam"), tree.pop("checksums")],
    lambda tree: tree.update(slam=None),
    lambda tree: tree.update(run_seconds="long"),
    lambda tree: tree["slam"].pop("mapper"),
]


def change_the_settings(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["tracking"]["window"] = 4
    (folder / "config.json").write_text(json.dumps(config))


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (truncate, "in .*checkpoint.npz, found a damaged or another file; remove it, and start"),
        (grow_older, f"version = 0.0 .* found {minislam.__version__}; resume it with that version"),
        (change_an_image, "expected frame 1 as the interrupted run in .* read it, found another"),
        (change_the_settings, "expected settings.tracking.window = 10 like .* found 4"),
        (partial(remove, "checkpoint.npz"), "an interrupted run in .*, found no checkpoint.npz"),
        (partial(remove, "config.json"), "expected a readable file .*config.json"),
        *[(partial(tamper, change), "state of a run .*; remove it, and") for change in TAMPERED],
        (shutil.rmtree, "expected a run folder, found no folder at .*"),
    ],
)
def test_a_harmed_folder_is_refused(
    harm: Callable[[Path], None], words: str, interrupted: Path, tmp_path: Path, capsys
):
    out = shutil.copytree(interrupted, tmp_path / "out")
    harm(out)
    before = contents(out)
    assert main(["run", "synth:person", *INPUT, "-o", str(out), "--resume"]) == 1
    assert_one_sentence(words, capsys)
    assert contents(out) == before


def test_a_folder_must_be_named_and_resume_is_no_overwrite(interrupted: Path, capsys):
    assert main(["run", "synth:person", *INPUT, "--resume"]) == 1
    assert_one_sentence("expected --output FOLDER with --resume, found none", capsys)
    with pytest.raises(SystemExit) as ended:
        run("synth:person", interrupted, "--resume", "--overwrite")
    assert ended.value.code == 2 and "not allowed with" in capsys.readouterr().err


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_one_sentence(words: str, capsys) -> None:
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("minislam:")]
    assert len(said) == 1 and re.search(words, said[0]), said
