"""Bad options, settings, commands and outputs for `bad_inputs`; runs to the end."""

import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from minislam.config import SlamConfig
from minislam.parameters import leaves
from tests.benchmarks.bad_files import CODE, FOREIGN, NOISE, picture
from tests.benchmarks.bad_input_case import EITHER, REFUSED, RUN, Case, Spoil, content, replaced


def options() -> Iterator[Case]:
    """Values of options, and of every setting that is a number."""
    texts = """--size 0x0|--size 8x8|--size 96|--size axb|--size -96x72|--size 1e3x72|--size 96x72x3
        --size 99999x72|--stride 0|--stride -1|--stride 1.5|--stride x|--stride 9e9|--start -1
        --start 4|--start 99999999999999999999999|--max-frames 0|--max-frames -3|--fx 0|--fx -1
        --fx nan|--fx inf|--fx 1e300|--fy -2|--cx -5|--cx 1e5|--cy nan|--focal maybe|--focal ""
        --calibration nowhere.txt|--calibration mine.txt|--calibration good|--masks masks
        --masks files:|--masks files:nowhere|--masks files:truth.txt|--depth-scale 0
        --depth-scale -1|--depth-scale nan|--pixels 0|--pixels -5|--pixels x|--depth laser
        --depth files:nowhere|--depth simulated|--depth sensor|--depth ""
        --flow droid|--flow fast|--features dinov3|--features files:nowhere|--device tpu
        --device cuda|--precision fp16|--precision int4|--seed -1|--seed 1.5|--seed x|--threads 0
        --seed 99999999999999999999999|--threads 1e9|--threads x|--preset desktop|--preset ""
        --workers -1|--workers x|--workers 1.5|--checkpoint_fraction -1|--checkpoint_fraction nan
        --tracking.windw 3|--tracking 3|--tracking.window|--tracking.window=|--lpips-trunk a
        --lpips-heads mine.txt|--depth-weights mine.txt|--nonsense|--overwrite --resume
        --config nowhere|--config good|--resume|--depth metric3d --depth-weights nowhere"""
    for text in " | ".join(texts.splitlines()).split("|"):
        # A later option replaces the earlier one of RUN.
        yield Case("options", text.strip(), f"{RUN.format('good')} {text.strip()}")
    for number, (name, value, entry) in enumerate(leaves(SlamConfig())):
        least, most = entry.metadata["least"], entry.metadata["most"]
        bad = (f"{least - 1:g}", f"{10 * abs(most) + 1:g}", "nan", "x", "")[number % 5]
        if isinstance(value, bool):
            bad = "maybe"
        if not isinstance(value, str) and not (number % 5 == 0 and isinstance(value, bool)):
            text = f"--{name}={bad}"
            yield Case("settings", text, f"{RUN.format('good')} {text}")


def config_files() -> Iterator[Case]:
    """JSON of --config."""
    texts = ["", "{", "[]", "3", "null", '"text"', '{"tracking": 3}', '{"tracking": []}',
             '{"tracking": {"window": "x"}}', '{"tracking": {"window": null}}',
             '{"tracking": {"window": []}}', '{"tracking": {"window": NaN}}', '{"seed": 1e999}',
             '{"seed": -1}', '{"seed": true}', '{"seed": ' + "9" * 5000 + "}", '{"": 3}',
             '{"input": []}', '{"input": 3}', '{"input": {"stride": 0}}', '{"input": {"strid": 1}}',
             '{"input": {"size": [1, 2, 3]}}', '{"input": {"size": "a"}}', '{"priors": []}',
             '{"input": {"size": [96]}}', '{"input": {"max_frames": 1.5}}', '{"tracking.x.y": 3}',
             '{"priors": {"depth": 3}}', '{"priors": {"dept": "none"}}', "[" * 100_000,
             '{"input": {"fx": "nan"}}', '{"priors": {"depth": {}}}', '{"mapping": {"a": {}}}',
             '{"mapping": {"ssim": {"x": 1}}}', '{"uncertainty.enabled": "maybe"}']  # fmt: skip
    for text in [*texts, NOISE, '{"seed": 1}'.encode("utf-16")]:
        spoil = content("c.json", text)
        command = RUN.format("good --config c.json")
        yield Case(
            "config", str(text)[:50], command, spoil, EITHER if "{}}" in str(text) else REFUSED
        )
    for text in ("{}", '{"sequence": null}', '{"sequence": 3}', '{"sequence": ["good"]}',
                 '{"sequence": "nowhere"}', '{"sequence": ""}'):  # fmt: skip
        yield Case("config", text, RUN.format("--config c.json"), content("c.json", text))


def commands() -> Iterator[Case]:
    """Other commands than run: what they are given, and where they shall write."""
    texts = """eval|eval truth.txt|eval nowhere truth.txt|eval truth.txt nowhere|eval good truth.txt
        eval mine.txt truth.txt|eval truth.txt good|eval xyz truth.txt truth.txt
        eval truth.txt truth.txt --t_max_diff nan|eval truth.txt truth.txt --t_offset 1e9
        eval truth.txt truth.txt --t_max_diff -1|eval truth.txt truth.txt --rpe --delta 0
        eval truth.txt truth.txt --rpe --delta nan|eval truth.txt truth.txt --rpe --delta 1e9
        eval truth.txt truth.txt --rpe --delta -1|eval truth.txt truth.txt --no_align -a
        eval truth.txt truth.txt --rpe --delta 1.5 --delta_unit f|eval truth.txt truth.txt --delta x
        eval truth.txt truth.txt --save_results /dev/null
        eval truth.txt truth.txt --save_results good
        eval truth.txt truth.txt --save_results nowhere/a.json
        eval truth.txt truth.txt --save_plot nowhere/a.png
        eval truth.txt truth.txt --nonsense|render|render run|render nowhere -o a.webm
        render good -o a.webm|render run -o a.gif|render run -o a|render run -o nowhere/a.webm
        render run -o a.webm --path up|render run -o a.webm --size 0x0|render run -o good
        render run -o a.webm --size 1x1|render run -o a.webm --size 99999x99999
        export|export run|export nowhere --points a.ply|export good --points a.ply
        export run --points mine.txt|export run --colmap good|export run --masks mine.txt
        export run --sh-degree 4|export run --depth good|export run --points nowhere/a.ply
        export run --nerfstudio mine.txt/a|settings xyzzy|settings --nonsense|weights
        weights fetch|weights fetch nothing|weights check nowhere|weights check good|weights burn
        priors|priors good|priors good -o p|priors nowhere -o p --depth sensor
        priors good -o good --features classical|priors good -o p --features nothing
        priors good -o p --depth none|bench|bench nowhere -o b|bench good -o b|bench mine.txt -o b
        notebooks|notebooks mine.txt|notebooks mine.txt/a|grade|grade nowhere|grade mine.txt
        grade mine.txt --seed -1|rum|run|run nowhere|run synth:nothing|run synth:|run synth:ball:-1
        run synth:ball:x|run synth:ball:1:2|run http://127.0.0.1/a.mp4|run ""|run good good|-x
        doctor --nonsense|demo --nonsense|demo -o mine.txt|--nonsense|help nothing"""
    for text in " | ".join(texts.splitlines()).split("|"):
        yield Case("commands", text.strip(), text.strip())
    graded = {"not JSON": "{", "a list": "[]", "empty": "{}", "no cells": '{"cells": 3}',
              "cells of 3": '{"cells": [3], "metadata": {}, "nbformat": 4}'}  # fmt: skip
    for label, text in graded.items():
        name = "03_splatting_gradients.ipynb"
        yield Case("commands", f"grade {label}", f"grade {name}", content(name, text))
    for name in ("camera.json", "map.ply", "trajectory.txt", "config.json", "uncertainty_mlp.pt"):
        for label, data in (FOREIGN | {"code": CODE, "{}": b"{}", "[]": b"[]"}).items():
            command = "render run -o a.webm --path side-by-side"
            if (name, label) != ("config.json", "{}"):
                yield Case("folders", f"{name} {label}", command, content(f"run/{name}", data))
        command = "export run --nerfstudio n"
        missing = replaced(f"run/{name}", lambda path: None)
        yield Case("folders", f"no {name}", command, missing)


def outputs() -> Iterator[Case]:
    """Run folders that cannot be, or that are somebody's."""
    for name in ("mine.txt", "mine.txt/out", "good", "/dev/null", "/dev/null/a", "/proc/a",
                 "/sys/a", "a" * 300, "b/" * 3000, "good/0.png", "out\0", "fifo", "link",
                 "tum"):  # fmt: skip
        for more in ("", " --overwrite", " --resume"):
            command = f"run good --preset test -q --workers 1 -o {name}{more}"
            yield Case("outputs", command[-60:], command, _special)
    for inputs in ("run/keyframes", "run"):
        command = f"run {inputs} --preset test -q -o run --overwrite"
        yield Case("outputs", f"{inputs} in the output", command)
    for kind, names in {"keyframes": "good", "plots": "good", "config.json": "mine.txt"}.items():
        command = "run photos --preset test -q -o run --overwrite"
        yield Case("outputs", f"{kind} is a link", command, _linked(kind, names))
    zipped = io.BytesIO()
    zipfile.ZipFile(zipped, "w").writestr("a.npy", bytes(8))
    yield Case(
        "outputs", "a zip as run folder", "render z -o a.webm", content("z", zipped.getvalue())
    )


def _special(folder: Path) -> None:
    os.mkfifo(folder / "fifo")
    (folder / "link").symlink_to("good")


def _linked(kind: str, target: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / "run" / kind).rename(folder / "aside")
        (folder / "run" / kind).symlink_to(folder / target)

    return spoil


def whole_runs() -> Iterator[Case]:
    """Runs to the end: degenerate pictures and extreme, but legal, settings."""
    flat = {"black": 0, "white": 255}
    for label, value in flat.items():
        yield Case("whole", label, RUN.format("good"), _every("good", value), REFUSED)
    for label, spoil in {"the same": _same, "noise": _noisy}.items():
        yield Case("whole", label, RUN.format("good"), spoil, EITHER)
    legal = """--fx 1e8|--fx 0.001|--cx 0 --cy 0|--size 16x16|--size 400x16|--max-frames 1
        --max-frames 2|--start 2|--stride 3|--mapping.init_iterations 0|--seed 4294967295
        --mapping.refine_iterations 0|--tracking.window 2|--depth files:depth|--masks files:masks
        --features files:features|--no-uncertainty|--tracking.warmup_keyframes 2
        --uncertainty.grid_factor 2|--checkpoint_fraction 0|--checkpoint_fraction 1"""
    for text in " | ".join(legal.splitlines()).split("|"):
        command = f"{RUN.format('good')} {text.strip()}"
        yield Case("whole", text.strip(), command, None, EITHER)


def _every(name: str, value: int) -> Spoil:
    def spoil(folder: Path) -> None:
        for path in (folder / name).iterdir():
            path.write_bytes(picture(path.suffix, 72, 96, 3, value=value))

    return spoil


def _same(folder: Path) -> None:
    for path in (folder / "good").iterdir():
        path.write_bytes((folder / "good/0.png").read_bytes())


def _noisy(folder: Path) -> None:
    for number, path in enumerate((folder / "good").iterdir()):
        noise = np.random.default_rng(number).integers(0, 256, (72, 96, 3), dtype=np.uint8)
        path.write_bytes(cv2.imencode(".png", noise)[1].tobytes())
