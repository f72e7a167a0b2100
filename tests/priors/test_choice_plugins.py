"""Priors of other modules and packages are found by name, and refused in a sentence."""

import sys
from pathlib import Path

import pytest

from minislam.errors import InputError
from minislam.priors.choice import load_plugin
from minislam.priors.depth import NoDepth
from minislam.priors.names import plugins

MODULE = """\
class Plane:
    def __init__(self, device, weights=None):
        self.made_with = device, weights

    def __call__(self, frame, camera):
        return 2 + 0 * frame.image[..., 0]

def broken(device):
    raise OSError("no such file\\nsecond line")

def ends(device):
    raise SystemExit(5)

def wrong(device):
    return lambda frame, camera: frame.image

number = 3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Stand in a folder with a module, which is also an installed package."""
    (tmp_path / "my_priors.py").write_text(MODULE)
    info = tmp_path / "my_priors-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-priors\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[minislam.depth]\nplane = my_priors:Plane\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("my_priors", None)


# Known answers


def test_a_module_of_the_current_folder_makes_a_prior_of_device_and_file():
    assert load_plugin("depth", "python:my_priors:Plane", "cpu", None).made_with == ("cpu", None)
    assert load_plugin("depth", "python:my_priors:Plane", "cpu", "w").made_with == ("cpu", "w")


def test_an_installed_package_gives_its_prior_a_name(tmp_path: Path):
    assert plugins("depth") == {}
    sys.path.append(str(tmp_path))
    assert list(plugins("depth")) == ["plane"] and plugins("flow") == {}
    assert load_plugin("depth", "plane", "cpu", None).made_with == ("cpu", None)


def test_what_this_package_holds_can_be_named_like_a_plugin():
    make = "python:minislam.priors.features:ClassicalFeatures"
    with pytest.raises(InputError, match=r"TypeError: ClassicalFeatures\(\) takes no"):
        load_plugin("features", make, "cpu", None)  # its argument is no device
    assert NoDepth()(None, None) is None


# Errors


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("python:my_prior:Plane", "ModuleNotFoundError: No module named 'my_prior'; write it like"),
        ("python:my_priors:Plan", "AttributeError: module 'my_priors' has no attribute 'Plan'"),
        ("python:my_priors", "found TypeError: 'module' object is not callable"),
        ("python:my priors:Plane", "expected --depth python:my priors:Plane to name"),
        ("python:", "expected --depth python: to name a function"),
        ("python:my_priors:number", "found TypeError: 'int' object is not callable"),
        ("python:my_priors:broken", "found OSError: no such file; write"),
        ("python:my_priors:ends", "found SystemExit: 5; write"),
        ("python:my_priors:wrong", "expected --depth python:my_priors:wrong to return a finite te"),
    ],
)
def test_what_is_no_prior_is_one_sentence(name: str, words: str):
    with pytest.raises(InputError) as caught:
        load_plugin("depth", name, "cpu", None)
    assert words in str(caught.value) and "\n" not in str(caught.value)
