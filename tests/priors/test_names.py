"""The names of priors are known, and checked, without torch."""

import subprocess
import sys
from pathlib import Path

import pytest

from minislam.errors import InputError
from minislam.priors.names import require_prior
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


def test_no_torch_is_needed():
    program = "import sys, minislam.priors.names; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
