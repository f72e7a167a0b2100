"""Synthetic sequences, rendered into the cache: their truth, and what cannot be rendered."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.errors import InputError

pytestmark = pytest.mark.slow

# Known answers


def test_a_synthetic_sequence_is_read_with_its_truth(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    options = InputOptions(max_frames=3, size=(64, 48))
    sequence = open_sequence("synth:static:3", options)
    assert sequence.name == "static-3" and len(sequence) == 3 and sequence.warnings == []
    assert sequence.camera.width == 64
    assert len(sequence.ground_truth.trajectory) == 3
    assert not sequence.ground_truth.moving_mask(0).any()
    np.testing.assert_allclose(sequence.frame(1).timestamp, 1 / 30, atol=1e-6)


def test_a_phone_films_a_synthetic_sequence_without_saying_its_focal_length(tmp_path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    options = InputOptions(max_frames=2, size=(24, 32))
    filmed, plain = (open_sequence(f"synth:static:3{end}", options) for end in ("?phone", ""))
    assert filmed.name == "static-3-phone" and filmed.refines_focal and not plain.refines_focal
    assert len(filmed.ground_truth.trajectory) == 2
    assert (filmed.frame(1).image - plain.frame(1).image).abs().max() > 0.05


def test_rendering_reports_its_progress(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    calls = []
    options = InputOptions(max_frames=2, size=(32, 24))
    open_sequence("synth:static", options, lambda done, total: calls.append((done, total)))
    assert calls[-1] == (2, 2)
    open_sequence("synth:static", options, lambda done, total: calls.append((done, total)))
    assert calls[-1] == (2, 2)  # from the cache: nothing to wait for


# Errors


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path / "file"))
    with pytest.raises(InputError, match="MINISLAM_CACHE"):
        open_sequence("synth:static", InputOptions(max_frames=2, size=(32, 24)))


def test_what_cannot_be_rendered_is_no_matter_of_the_cache(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    for options, words in (
        (InputOptions(size=(5000, 64)), "width and height must be 16 to 4096 pixels, not 5000x64"),
        (InputOptions(start=10**9, max_frames=2), "at most 100,000 frames, not 1,000,000,002"),
    ):
        with pytest.raises(InputError, match=f"expected to render synth:ball, but: .*{words}$"):
            open_sequence("synth:ball", options)
