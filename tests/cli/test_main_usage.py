"""Help without torch, hints after wrong words, and what is refused before anything is loaded."""

import re
import subprocess
import sys

import pytest

from minislam.cli.main import main
from tests.cli.test_main import the_sentence

pytestmark = pytest.mark.slow

# Help

COMMANDS = "demo run settings priors weights bench notebooks eval render export doctor".split()


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_has_help(command: list[str], capsys):
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "usage: minislam" in text and "--help" in text


@pytest.mark.parametrize("arguments", [["--help"], *([name, "-h"] for name in COMMANDS), ["run"]])
def test_what_needs_no_torch_answers_without_it(arguments: list[str]):
    program = (
        "import sys\nfrom minislam.cli.main import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit: pass\n"
        "print('torch' in sys.modules, 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "False False", done.stderr


def test_no_command_shows_the_help_and_is_wrong_usage(capsys):
    # As ruff and uv do: a script that forgot the command must not go on.
    assert main([]) == 2
    alone = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["help"])
    assert alone == capsys.readouterr().out and "doctor" in alone


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nofile.mp4"], "but nofile.mp4 does not exist"),
        (["synth:nothing"], "with NAME one of .*crowd"),
        ([".", "--depth", "metric3d"], "expected --depth-weights FILE with --depth metric3d"),
        ([".", "--depth", "metric3d", "--depth-weights", "no.pth"], "found nothing at no.pth"),
        ([".", "--flow", "raft"], "expected --flow classical, droid or .* found 'raft'"),
        ([".", "--depth", "files:nowhere"], "found nothing at nowhere"),
        ([".", "--stride", "0"], "stride of at least 1"),
        ([".", "--device", "tpu"], "expected --device cpu or cuda"),
        ([".", "--config", "nowhere.json"], "a readable file nowhere.json"),
    ],
)
def test_what_is_wrong_is_said_before_torch_is_loaded(arguments: list[str], words: str):
    program = (
        "import os, sys\nos.environ['MINISLAM_CACHE'] = os.devnull\n"
        f"from minislam.cli.main import main\ncode = main(['run', *{arguments!r}])\n"
        "print(code, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "1 False\n" and re.search(words, done.stderr), done.stderr


# Wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["rnu"], "expected a command, found 'rnu'; the nearest is run"),
        (["xyz"], "expected a command, found 'xyz'; choose one of demo, run"),
        (["run", "a", "--strid", "2"], "found --strid; the nearest is --stride"),
        (["run", "a", "--strid=2"], "found --strid; the nearest is --stride"),
        (["run", "a", "--max_frames", "2"], "the nearest is --max-frames"),
        (["run", "a", "--quite"], "the nearest is --quiet"),
        (["run", "a", "--end", "5"], "found --end; see minislam run --help"),
        (["run", "a", "--fps", "5"], "found --fps; see minislam run --help"),
        (["run", "a", "--zoom", "2"], "found --zoom; see minislam run --help"),
        (["run", "a", "b"], "expected only the names that minislam run takes, found also 'b'"),
        (["run", "synth:crowd", "--window", "3"], "the nearest is --tracking.window"),
        (["run", "synth:crowd", "--tracking.windw", "3"], "the nearest is --tracking.window"),
        (["run", "synth:crowd", "--tracking.windo=3"], "the nearest is --tracking.window"),
        (["eval", "a", "b", "--rep"], "the nearest is --rpe"),
        (["demo", "--stride", "3"], "found --stride; it is an option of minislam run"),
        (["demo", "--max-frames", "3"], "it is an option of minislam run"),
        (["demo", "--size=96x72"], "it is an option of minislam run"),
        (["priors", "a", "--out", "b", "--workers", "2"], "it is an option of minislam run"),
        (["priors", "a", "--out", "b", "--output", "c"], "the nearest is --out"),
        (["doctor", "--every.thing", "3"], "found --every.thing; see minislam doctor --help"),
    ],
)
def test_wrong_usage_is_a_hint_and_exit_code_2(arguments: list[str], words: str, capsys):
    assert main(arguments) == 2
    assert words in the_sentence(capsys)


@pytest.mark.parametrize(
    "arguments", [["weights", "fly"], ["run", "a", "--size", "big"], ["run", "a", "-q", "-v"]]
)
def test_wrong_usage_is_exit_code_2(arguments: list[str], capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert len(capsys.readouterr().err) < 500
