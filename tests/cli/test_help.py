"""The short and the long help, and the nearest name."""

import argparse

import pytest

from data_synth import SEQUENCES
from minislam.cli.help import ESSENTIAL, RUN_EPILOG, unknown_option
from minislam.cli.main import main
from minislam.errors import nearest


def help_of(monkeypatch, capsys, *arguments: str) -> str:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        main([*arguments])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", [[], ["demo"], ["run"], ["priors"]])
def test_the_short_help_has_at_most_40_lines_of_80_characters(command, monkeypatch, capsys):
    lines = help_of(monkeypatch, capsys, *command, "-h").splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 88


def test_the_long_help_of_run_has_every_option_and_the_files(monkeypatch, capsys):
    short, long = (help_of(monkeypatch, capsys, "run", flag) for flag in ("-h", "--help"))
    assert "--stride" in short and "--depth-scale" not in short and "exit codes: 0" not in short
    assert all(name in long for name in ("--depth-scale", "--lpips-heads", "--threads"))
    assert long.endswith(RUN_EPILOG) and "minislam settings" in short + long
    clips = " ".join(
        long.partition("synthetic clips, synth:NAME[:SEED][?phone, as one films it]: ")[2].split()
    )
    assert clips.startswith(", ".join(SEQUENCES)) and "synthetic clips" not in short


def test_the_help_of_priors_leaves_out_what_changes_nothing_there(monkeypatch, capsys):
    text = help_of(monkeypatch, capsys, "priors", "--help")
    assert "--stride" in text and "--seed" in text
    assert not any(name in text for name in ("--no-unc", "--checkpoint_fraction", "--masks"))


def test_every_essential_option_exists(monkeypatch, capsys):
    shown = help_of(monkeypatch, capsys, "run", "-h") + help_of(monkeypatch, capsys, "priors", "-h")
    assert [name for name in ESSENTIAL if name not in shown] == []


def test_the_nearest_name_is_similar_or_none():
    assert nearest("--strid", ["--stride", "--start"], "none") == "the nearest is --stride"
    assert nearest("--zoom", ["--stride", "--start"], "none") == "none"


def test_a_name_too_many_is_no_option():
    parser = argparse.ArgumentParser("minislam eval")
    assert "found also 'c.txt'" in str(unknown_option("c.txt", parser))
    assert "see minislam eval --help" in str(unknown_option("--x", parser))
