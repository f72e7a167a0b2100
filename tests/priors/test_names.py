"""The names of priors are known, and checked, without torch."""

import subprocess
import sys
from pathlib import Path

import pytest

from minislam.errors import InputError
from minislam.priors.names import PriorChoice, require_prior
from minislam.priors.networks.table import NETWORKS


def test_every_network_of_the_table_is_known_and_needs_its_weights(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    (tmp_path / "my.pth").touch()
    for network in NETWORKS:
        with pytest.raises(InputError, match=f"minislam weights fetch {network.name}"):
            require_prior(network.kind, network.name, None)
        given = str(tmp_path / "my.pth")
        assert require_prior(network.kind, network.name, given) == given


def test_what_reads_no_weights_reads_none():
    assert require_prior("flow", "classical", None) is None
    assert require_prior("depth", "python:a:b", "c.pth") == "c.pth"


def test_a_folder_of_files_must_exist(tmp_path: Path):
    assert require_prior("features", f"files:{tmp_path}", None) is None
    with pytest.raises(InputError, match="expected a folder of features files, found nothing at"):
        require_prior("features", f"files:{tmp_path}/nowhere", None)


def test_what_a_run_folder_keeps_is_found_from_any_folder(tmp_path: Path, monkeypatch):
    (tmp_path / "droid.pth").touch()
    monkeypatch.chdir(tmp_path)
    given = PriorChoice(features="files:f", depth="python:my:depth", depth_weights="large")
    assert given.from_anywhere() == PriorChoice(
        features=f"files:{tmp_path}/f", depth="python:my:depth", depth_weights="large"
    )
    (tmp_path / "droid").touch()  # the name of the published file comes first
    found = PriorChoice(flow_weights="droid", features_weights="./droid.pth").from_anywhere()
    assert (found.flow_weights, found.features_weights) == ("droid", f"{tmp_path}/droid.pth")


def test_no_torch_is_needed():
    program = "import sys, minislam.priors.names; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
