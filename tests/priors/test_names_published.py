"""The list of published files: complete, and found where `minislam weights` puts them."""

import re
from pathlib import Path

import pytest

from minislam.priors.names import find_weights, published_files
from minislam.priors.networks.table import NETWORKS

ROWS = published_files()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    return tmp_path / "weights"


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS.keys())
def test_a_row_says_what_must_be_known_before_a_download(row):
    assert row.licence and float(row.megabytes) > 0 and row.url.startswith("https://")
    assert row.file in row.url or "drive.google.com" in row.url
    assert re.fullmatch("([0-9a-f]{64})?", row.sha256)


def test_every_network_has_a_file_that_is_called_like_it():
    for network in NETWORKS:
        assert ROWS[network.name].use == f"--{network.kind} {network.name}"
    assert len({row.file for row in ROWS.values()}) == len(ROWS)


def test_the_cache_may_be_named_from_a_home(monkeypatch: pytest.MonkeyPatch):
    row = ROWS["dinov2"]
    monkeypatch.setenv("MINISLAM_CACHE", "~/weights of mine")
    assert row.path == Path.home() / "weights of mine" / "weights" / row.file


def test_a_network_finds_what_was_fetched_and_what_is_named(cache: Path):
    use = "--depth metric3d"
    assert find_weights(use, None) is None and find_weights(use, "my.pth") == "my.pth"
    large = str(cache / "metric_depth_vit_large_800k.pth")
    assert find_weights(use, "metric3d-large") == large  # named, so it is missed by its path
    cache.mkdir()
    (cache / "metric_depth_vit_large_800k.pth").write_bytes(b"")
    assert find_weights(use, None) is None  # the large one is slow: only by its name
    (cache / "metric_depth_vit_small_800k.pth").write_bytes(b"")
    assert find_weights(use, None) == str(cache / "metric_depth_vit_small_800k.pth")
    assert find_weights("--flow metric3d", None) is None
    assert find_weights("--depth none", None) is None
    assert find_weights("--lpips-heads", "lpips-heads") == str(cache / "alex.pth")
