"""A run from its name to its folder, and again from the config.json of that folder alone."""

import errno
import os
from pathlib import Path

import pytest

from minislam import slam
from minislam.cli.main import main
from minislam.config import SlamConfig
from minislam.data.files import read_json
from minislam.data.options import InputOptions
from minislam.data.run_folder import RunFolder
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.errors import InputError
from minislam.priors.choice import PriorChoice
from minislam.runs import pictures, run
from minislam.state.steps import SilentObserver, Steps
from minislam.stereo import dense_structure
from minislam.tracking import bundle_adjustment
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards.lens import BentLens, LensFit

pytestmark = pytest.mark.slow

COMMAND = [
    "run", "synth:person", "--stride", "3", "--max-frames", "10", "--size", "96x72", "--preset",
    "test", "--seed", "3", "--uncertainty.given_masks", "on", "--depth", "none",
]  # fmt: skip
SAME = ("trajectory.txt", "keyframe_trajectory.txt", "map.ply", "config.json")


def test_config_json_alone_gives_the_same_bytes_again(root: Path, monkeypatch):
    assert main([*COMMAND, "-o", str(root / "first")]) == 0
    config = str(root / "first/config.json")
    reports: list[str] = []
    # The second run writes a report after every step: not a byte of its results may change.
    monkeypatch.setattr(pictures, "PREVIEW_FRACTION", float("inf"))
    monkeypatch.setattr(pictures, "write_text", lambda path, html: reports.append(html))
    assert main(["run", "--config", config, "-o", str(root / "again")]) == 0
    for name in SAME:
        first, again = (root / run / name for run in ("first", "again"))
        assert first.read_bytes() == again.read_bytes(), name
    running = [html for html in reports if '<main class="running">' in html]
    assert len(running) >= 3 and len(reports) == len(running) + 2  # at the end: viewer and report
    assert "data:image/jpeg" in running[0] and "location.reload" in running[0]
    facts = RunFolder(root / "again").read_run()
    assert facts["failed_adjustments"] == 0 < facts["adjustments"]


def test_a_mask_that_is_missing_is_said_before_anything_is_done(root: Path, monkeypatch, capsys):
    original = RecordedSequence.given_mask
    monkeypatch.setattr(
        RecordedSequence, "given_mask", lambda self, k: None if k == 2 else original(self, k)
    )
    assert main([*COMMAND, "-o", str(root / "masks")]) == 1
    said = capsys.readouterr().err
    assert "a mask of movers for every frame" in said and "found none for 2" in said
    assert not (root / "masks").exists()
    assert main([*COMMAND, "--no-uncertainty", "-o", str(root / "masks")]) in (0, 3)


def test_a_run_begins_anew_on_straightened_images_if_an_unknown_lens_bends(
    root: Path, monkeypatch, capsys
):
    check, lens = slam.check_lens, LensFit(90.0, (-0.2, 0.05), -0.1, 0.3)
    asked: list[bool] = []

    def check_lens(graph: KeyframeGraph, is_unknown: bool) -> LensFit | None:
        asked.append(is_unknown)
        if is_unknown:
            raise BentLens(lens)
        return check(graph, is_unknown)

    monkeypatch.setattr(slam, "check_lens", check_lens)
    filmed, out = ["run", "synth:person?phone", *COMMAND[2:]], root / "bent"

    def interrupt(run: slam.Slam) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slam.Slam, "_refine_map", interrupt)
        assert main([*filmed, "-o", str(out)]) == 130
    assert asked == [True, False]
    assert main(["run", "--resume", "-o", str(out)]) in (0, 3) and len(asked) == 2
    said = capsys.readouterr().err
    assert "the corners by -10%: the run begins anew on straightened images, k1 = -0.200" in said
    given = RunFolder(out).read_config()["input"]
    assert (given["k1"], given["k2"], given["focal"]) == (-0.2, 0.05, "refine")
    assert read_json(out / "camera.json")["preparation"]["distortion"]["k1"] == -0.2
    log = (out / "log.txt").read_text(encoding="utf-8")
    assert log.index("synthetic sequence person") < log.index("begins anew on straightened images")
    facts = RunFolder(out).read_run()
    assert facts["began_anew"]["lens"]["radial"] == [-0.2, 0.05]
    assert any("begins anew on straightened images" in text for text in facts["warnings"])
    seconds = facts["seconds"]
    assert 0 < seconds["before the lens was known"] < seconds["total"]
    assert seconds["total"] >= sum(spent for stage, spent in seconds.items() if stage != "total")


@pytest.mark.parametrize("given", [{"depth": "files:d"}, {"features": "files:f"}, {}])
def test_images_that_files_belong_to_are_not_straightened(given: dict[str, str], monkeypatch):
    sequence, sought = open_sequence("synth:person?phone", InputOptions(max_frames=2)), []

    def refuse(*rest: object) -> None:
        sought.append(sequence.seeks_lens)
        raise InputError("far enough")

    monkeypatch.setattr(run, "choose_priors", refuse)
    with pytest.raises(InputError, match="far enough"):
        run.run_in_folder(sequence, SlamConfig(), PriorChoice(**given), "folder", SilentObserver())
    assert sought == [not given]


def test_a_run_whose_every_adjustment_fails_says_so(root: Path, monkeypatch, capsys):
    monkeypatch.setattr(bundle_adjustment, "_damped_step", lambda *arguments: None)
    out = root / "failed"
    # With a depth prior, because without one a map needs depth from the adjustments.
    assert main([*COMMAND[:-1], "simulated", "-o", str(out)]) == 3
    facts = RunFolder(out).read_run()
    assert facts["failed_adjustments"] == facts["adjustments"] > 0
    warning = f"{facts['adjustments']} of {facts['adjustments']} bundle adjustments failed"
    assert any(warning in text for text in facts["warnings"])
    assert warning in capsys.readouterr().err and facts["state"] != "finished"


def test_on_a_full_disk_the_way_on_is_said(root: Path, monkeypatch, capsys):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    fill = [False]
    fsync, finish = os.fsync, Steps.finish
    monkeypatch.setattr(os, "fsync", lambda file: full(file) if fill[0] else fsync(file))

    def finish_and_fill(steps: Steps, stage: str, done: int, total: int) -> None:
        fill[0] |= done == 4
        finish(steps, stage, done, total)

    monkeypatch.setattr(Steps, "finish", finish_and_fill)
    out = root / "full"
    assert main([*COMMAND, "--checkpoint_fraction", "1e9", "-o", str(out)]) == 1
    said = capsys.readouterr().err.splitlines()
    warned = [line for line in said if "no checkpoint of this state" in line]
    assert len(warned) == 1 and warned[0].endswith("No space left on device; free space")
    command = f"go on with: minislam run --resume -o {out}"
    space = f"minislam: expected space in {out}, found none; free space, then {command}"
    assert said[-1] == space and (out / "checkpoint.npz").exists()


def test_a_run_that_ends_without_a_map_keeps_its_trajectory(root: Path, monkeypatch):
    def no_depth(*arguments: object) -> list:
        raise InputError("expected some known depth, found none")

    monkeypatch.setattr(dense_structure, "with_swept_depth", no_depth)
    out = root / "no_map"
    assert main([*COMMAND, "-o", str(out)]) == 1
    folder = RunFolder(out)
    assert folder.read_run()["state"].startswith("failed: expected some known depth")
    assert len(folder.read_trajectory()) == folder.read_run()["frames"]
    assert not (out / "map.ply").exists()
