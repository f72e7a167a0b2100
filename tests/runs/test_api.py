"""The Python interface: what it takes, what it says, and how it leaves the process."""

import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import minislam
from minislam.errors import InputError
from minislam.mapping import Mapper
from minislam.priors.flow import ClassicalFlow
from minislam.runs import api

pytestmark = pytest.mark.slow


def test_what_is_known_at_the_end_alone_is_warned_of_once(tmp_path: Path, monkeypatch, capsys):
    def run_in_folder(*parts, **how):
        parts[-1].warn("early")
        return {}, {"warnings": ["early", "late"]}

    monkeypatch.setattr(api, "run_in_folder", run_in_folder)
    monkeypatch.setattr(api, "Run", Path)
    for quiet, said in ((False, "WARNING: early\nWARNING: late\n"), (True, "")):
        minislam.run("synth:person", tmp_path, max_frames=4, size=(96, 72), quiet=quiet)
        assert capsys.readouterr().err == said


@pytest.fixture
def two_threads() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(threads)


def test_opencv_has_the_threads_that_it_had(two_threads, tmp_path: Path, monkeypatch):
    def run_in_folder(*parts, **how):
        ClassicalFlow()
        assert cv2.getNumThreads() == 1
        raise KeyboardInterrupt

    monkeypatch.setattr(api, "run_in_folder", run_in_folder)
    with pytest.raises(KeyboardInterrupt):
        minislam.run("synth:person", tmp_path, max_frames=4, size=(96, 72))
    assert cv2.getNumThreads() == 2


def test_masks_of_the_user_are_used_as_on_the_command_line(root: Path, tmp_path: Path):
    for frame in range(30):  # of the source
        cv2.imwrite(str(tmp_path / f"{frame:05d}.png"), np.full((72, 96), 255 * (frame > 2), "u1"))
    done = minislam.run(
        "synth:person", root / "masked", preset="test", stride=3, max_frames=10, size=(96, 72),
        masks=f"files:{tmp_path}", depth="simulated", quiet=True,
    )  # fmt: skip
    assert done.config.uncertainty.given_masks
    with pytest.raises(InputError, match="either --masks or --no-uncertainty, found both; leave"):
        minislam.run(
            "synth:person", stride=3, max_frames=10, size=(96, 72), masks=f"files:{tmp_path}",
            settings={"uncertainty.enabled": False},
        )  # fmt: skip
    assert done.beta(5).min() > 1 > done.beta(0).max()


def test_the_door_shows_what_is_stable():
    assert set(minislam.__all__) - {"__version__"} == set(api.__all__) and dir(minislam)
    with pytest.raises(AttributeError):
        minislam.Slam  # noqa: B018


def test_ctrl_c_ends_a_quiet_run_after_the_present_step(root: Path, monkeypatch, capsys):
    refine = Mapper.refine

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return refine(*arguments)

    monkeypatch.setattr(Mapper, "refine", interrupted)
    done = minislam.run(
        "synth:person", root / "quiet", preset="test", stride=3, max_frames=10, size=(96, 72),
        quiet=True,
    )  # fmt: skip
    assert done.folder.read_run()["state"] == "interrupted"
    html = (root / "quiet/report.html").read_text(encoding="utf-8")
    assert f"<pre>go on with: minislam run --resume -o {root}/quiet</pre>" in html
    assert capsys.readouterr() == ("", "")
