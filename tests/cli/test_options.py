"""Flags, and the file of --config under them."""

import argparse
import json
from pathlib import Path

import pytest

import minislam.config
from minislam.cli.help import UsageError
from minislam.cli.options import (
    PRESETS,
    add_input,
    add_priors,
    add_settings,
    input_options,
    prior_choice,
    settings,
    source_of,
    take_settings,
)
from minislam.config import SlamConfig, settings_of, with_settings
from minislam.data.options import InputOptions
from minislam.errors import InputError
from minislam.priors.choice import PriorChoice

FILE = {
    "sequence": "synth:ball:3",
    "input": {"stride": 3, "size": [96, 72], "fx": 80, "max_frames": None},
    "priors": {"depth": "sensor"},
    "tracking": {"window": 4},
    "seed": 7,
}


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_input(parser)
    add_priors(parser, depth="none", with_flow=True)
    add_settings(parser)
    rest, given = take_settings(list(arguments))
    return argparse.Namespace(**vars(parser.parse_args(rest)), settings=given, parser=parser)


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "config.json"
    path.write_text(json.dumps(FILE))
    return str(path)


def test_without_flags_all_is_default():
    args = parse("a.mp4")
    assert source_of(args) == "a.mp4" and input_options(args) == InputOptions()
    assert prior_choice(args, "none") == PriorChoice() and settings(args) == SlamConfig()


def test_the_presets_are_those_of_the_configuration():
    assert PRESETS == tuple(minislam.config.PRESETS)


def test_names_with_a_dot_are_settings_wherever_they_stand():
    rest, given = take_settings(["--a.b", "-3", "x.mp4", "-o", "y.z", "--c.d=e=f", "--g"])
    assert rest == ["x.mp4", "-o", "y.z", "--g"] and given == {"a.b": "-3", "c.d": "e=f"}
    for wrong in (["--a.b", "-o", "out"], ["--a.b", "--c.d=3"], ["x.mp4", "--a.b"]):
        with pytest.raises(UsageError, match=r"expected a value after --a\.b, found none"):
            take_settings(wrong)


def test_behind_two_dashes_there_is_one_name():
    for name in ("-dash.mp4", "--dash.mp4"):
        assert take_settings(["-q", "--", name]) == (["-q", "--", name], {})
    with pytest.raises(UsageError, match="one name after --, found also --preset; put options fi"):
        take_settings(["--", "-dash.mp4", "--preset", "test"])


def test_settings_without_a_dot_are_options():
    changed = {"seed": 3, "threads": 2, "checkpoint_fraction": 0.5}
    given = parse("--seed", "3", "--threads", "2", "--checkpoint_fraction", "0.5")
    assert settings(given) == with_settings(SlamConfig(), changed)
    assert {name for name in settings_of(SlamConfig()) if "." not in name} == set(changed)


def test_a_file_says_sequence_input_priors_and_settings(file: str):
    args = parse("--config", file)
    assert source_of(args) == "synth:ball:3"
    assert input_options(args) == InputOptions(stride=3, size=(96, 72), fx=80.0)
    assert prior_choice(args, "simulated") == PriorChoice(depth="sensor")
    assert settings(args) == with_settings(SlamConfig(), {"seed": 7, "tracking.window": 4})


def test_flags_replace_values_of_the_file(file: str):
    args = parse(
        "b.mp4", "--config", file, "--stride", "2", "--size", "64x48", "--depth", "none",
        "--tracking.window", "5",
    )  # fmt: skip
    assert source_of(args) == "b.mp4" and prior_choice(args, "simulated").depth == "none"
    assert input_options(args) == InputOptions(stride=2, size=(64, 48), fx=80.0)
    assert settings(args).tracking.window == 5 and settings(args).seed == 7


def test_every_input_option_is_a_flag_with_its_meaning_and_default(capsys):
    with pytest.raises(SystemExit):
        parse("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert "--stride VALUE use every n-th frame of the source [frame]; 1" in text
    assert "--depth-scale VALUE units of a depth image per metre" in text


def test_without_any_sequence_nothing_can_run():
    with pytest.raises(InputError, match=r"expected a SEQUENCE, or --config FILE .* found neither"):
        source_of(parse())


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("input", {"strid": 3}, "a known setting, found 'strid'; the nearest is stride"),
        ("input", {"stride": 2.5}, "stride to be of type int like 1, found 2.5"),
        ("input", {"stride": "two"}, "stride to be of type int like 1, found 'two'"),
        ("input", {"stride": None}, "stride to be of type int like 1, found None"),
        ("input", {"max_frames": 1.5}, "max_frames to be of type int, found 1.5$"),
        (
            "input",
            {"size": [96]},
            r"size to be of type tuple, found \[96\]; write size=\(320, ",
        ),
        ("input", 3, "settings as a JSON object, found int"),
        ("priors", {"depth": 3}, "depth to be of type str like 'none', found 3"),
    ],
)
def test_a_wrong_value_in_the_file_is_named(part: str, value: object, words: str, tmp_path: Path):
    (tmp_path / "a.json").write_text(json.dumps({part: value}))
    args = parse("--config", str(tmp_path / "a.json"))
    with pytest.raises(InputError, match=f"expected {words}"):
        input_options(args)
        prior_choice(args, "none")


@pytest.mark.parametrize("name", ["", "run.json", "metrics.json"])
def test_what_is_not_the_settings_of_a_run_names_them(name: str, file: str, tmp_path: Path):
    (tmp_path / "run.json").write_text('{"version": "1"}')
    args = parse("--config", str(tmp_path / name))
    for read in (source_of, settings):
        with pytest.raises(InputError, match=r"a file of settings, .*; give .*config\.json"):
            read(args)
    assert parse("--config", file).config == file and settings(parse("--config", file)).seed == 7


def test_the_file_may_be_named_from_the_home(file: str, tmp_path: Path, monkeypatch):
    for name in ("HOME", "USERPROFILE"):  # the second is that of Windows
        monkeypatch.setenv(name, str(tmp_path))
    assert settings(parse(f"--config=~/{Path(file).name}")).seed == 7


def test_masks_from_files_are_used_unless_that_is_switched_off():
    assert settings(parse("a", "--masks", "files:m")).uncertainty.given_masks
    assert input_options(parse("a", "--masks", "files:m")).masks == "files:m"
    off = parse("a", "--masks", "files:m", "--uncertainty.given_masks", "off")
    assert not settings(off).uncertainty.given_masks and settings(parse("a")) == SlamConfig()
