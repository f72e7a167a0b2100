"""Doctor tries the installation out, and says if something is wrong with it."""

import os
import sys
from pathlib import Path

import pytest

from minislam.cli import doctor
from minislam.cli.main import main
from minislam.priors import conformance


def test_doctor_says_what_is_installed_and_tries_the_flow(capsys: pytest.CaptureFixture[str]):
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "torch " in out and "self-test   flow of a shifted image, off by 0.0" in out


def test_a_flow_that_is_wrong_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(conformance, "flow_error", lambda *_: float("nan"))
    assert main(["doctor"]) == 1
    assert "expected the self-test to be exact to 0.1 px, found nan px" in capsys.readouterr().err


def test_what_is_missing_is_said_and_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys):
    for name in ("torch", "cv2"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["doctor"]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("minislam ")
    found = f"minislam: expected torch, cv2 in this Python, {sys.executable}, found none; activate"
    assert printed.err.startswith(found) and "environment.txt" in printed.err


class Package:
    """What importlib.metadata tells of an installed package."""

    def __init__(self, name: str) -> None:
        self.metadata = {"Name": name}


@pytest.mark.parametrize(
    ("names", "warned"),
    [
        (["torch", "opencv-python-headless"], False),
        (["opencv-python-headless", "OpenCV-Python", "torch"], True),
    ],
)
def test_two_packages_of_opencv_are_warned_of(monkeypatch, names: list[str], warned: bool):
    monkeypatch.setattr("importlib.metadata.distributions", lambda: map(Package, names))
    found = list(doctor.installation_warnings(torch_sees_a_gpu=True))
    assert bool(found) == warned
    assert not warned or "opencv-python, opencv-python-headless share one folder" in found[0]


@pytest.mark.skipif(os.name != "posix", reason="the stand-in for nvidia-smi is a shell script")
def test_a_gpu_that_torch_does_not_see_is_warned_of(tmp_path: Path, monkeypatch):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'GPU 0: NVIDIA A100 (UUID: GPU-1)'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("importlib.metadata.distributions", lambda: [])
    assert list(doctor.installation_warnings(torch_sees_a_gpu=True)) == []
    [warning] = doctor.installation_warnings(torch_sees_a_gpu=False)
    assert "torch sees no GPU 0: NVIDIA A100: install" in warning
    tool.write_text("#!/bin/sh\necho 'No devices were found'; exit 6\n")
    assert list(doctor.installation_warnings(torch_sees_a_gpu=False)) == []
    tool.unlink()
    assert list(doctor.installation_warnings(torch_sees_a_gpu=False)) == []
