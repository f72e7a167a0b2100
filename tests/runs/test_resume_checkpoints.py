"""How often checkpoints are saved, and what a full disk does."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from minislam.config import preset, with_settings
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from minislam.priors.choice import PriorChoice
from minislam.runs import resume

pytestmark = pytest.mark.slow


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(resume, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    return clock


class Folder:
    """Stands for a run folder on a disk that takes two seconds, or is full."""

    path, is_full, written = Path("out"), False, 0

    def __init__(self, clock: SimpleNamespace) -> None:
        self.clock = clock

    def write(self, path: Path, tree: dict[str, object]) -> None:
        assert path == self.path / "checkpoint.npz"
        self.clock.now += 2
        if self.is_full:
            raise InputError("expected to be able to write, but the disk is full; choose another")
        self.written += 1


@pytest.fixture
def folder(clock: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> Folder:
    folder = Folder(clock)
    monkeypatch.setattr(resume, "write_checkpoint", folder.write)
    return folder


def checkpoints(folder: Folder, fraction: str) -> resume.Checkpoints:
    config = with_settings(preset("test"), {"checkpoint_fraction": fraction})
    sequence = open_sequence("synth:person", InputOptions(stride=3, max_frames=4, size=(96, 72)))
    return resume.Checkpoints(folder, sequence, config, PriorChoice())


SLAM = SimpleNamespace(saved_state=dict, sequence=SimpleNamespace(checksums={}))


def test_checkpoints_take_no_larger_fraction_of_the_time(
    root: Path, clock: SimpleNamespace, folder: Folder
):
    kept = checkpoints(folder, "0.01")
    for _ in range(1000):
        clock.now += 1
        kept.save(SLAM, False)
    assert folder.written == 5 and kept.seconds == 10  # at 1, 201, 401, ... seconds
    kept.save(SLAM, True)
    assert folder.written == 6


def test_a_fraction_of_zero_writes_none(root: Path, folder: Folder):
    kept = checkpoints(folder, "0")
    kept.save(SLAM, False)
    kept.save(SLAM, True)
    assert folder.written == 0


def test_a_full_disk_ends_no_run(root: Path, folder: Folder):
    kept = checkpoints(folder, "0.01")
    folder.is_full = True
    kept.save(SLAM, True)
    assert "no checkpoint of this state: " in kept.problem and "; free space" in kept.problem
    assert "the disk is full" in kept.problem and "choose another" not in kept.problem
    folder.is_full = False
    kept.save(SLAM, True)
    assert kept.problem is None
