"""Measure what notebooks 08 and 10 show but cannot run while one reads.

    nice python -m tests.benchmarks.bench_course beta|weights|paper|prior

beta    a clip on which beta holds the camera, with beta and without; some minutes
weights without the robust weight and the memory of motion, with beta and without; two minutes
paper   rows (a) to (d) of the paper's ablation, whole runs; some minutes
prior   rows (i) to (iv) of its supplement, tracking alone; a minute

Each run is stored when it ends, in notebooks/results/NAME.json, with the command and the commit. A
row that is there is not run again: to measure anew, remove the file first.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch

import minislam
from minislam.config import preset, with_settings
from minislam.data.files import atomic_write
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from tests.benchmarks.bench_movers import errors

ROOT = Path(__file__).parent.parent.parent
RESULTS = ROOT / "notebooks" / "results"
SHOWN = ("ate_all_cm", "ate_keyframes_cm", "psnr_input_db", "psnr_masked_db", "beta_auroc")
SHORT: dict[str, Any] = {"stride": 3, "max_frames": 28, "size": (128, 96)}
SHORT_CLIPS = ("umbrella", "stones:53")

# The paper's rows are of the paper's Eq. (5), with the prior that the presets use as a start only.
PRIOR = {"tracking.lambda_disparity_prior": 0.0005}
COMMON: dict[str, dict[str, Any]] = {"beta": {}, "weights": {}, "paper": PRIOR, "prior": PRIOR}
ROWS: dict[str, dict[str, dict[str, Any]]] = {
    "beta": {"with beta": {}, "without beta": {"uncertainty.enabled": False}},
    "paper": {
        "ours": {},
        "(a)": {"uncertainty.enabled": False},
        "(b)": {"uncertainty.lambda_depth": 0.0},
        "(c)": {"uncertainty.given_masks": True},
        "(d)": {"tracking.lambda_disparity_prior": 0.0},
    },
    "weights": {
        "beta alone": {"tracking.robust_scale": 0.0, "tracking.motion_memory": 0.0},
        "without both": {
            "uncertainty.enabled": False,
            "tracking.robust_scale": 0.0,
            "tracking.motion_memory": 0.0,
        },
    },
    "prior": {
        "(i)": {"tracking.prior_mask": False, "tracking.final_prior": True},
        "(ii)": {"tracking.final_prior": True},
        "(iii)": {"tracking.prior_mask": False},
        "(iv)": {},
    },
}
CLIPS = {
    "beta": ("stones:53",),
    "weights": ("umbrella",),
    "paper": SHORT_CLIPS,
    "prior": SHORT_CLIPS,
}
INPUT = {"beta": {"size": (160, 120)}, "weights": SHORT, "paper": SHORT, "prior": SHORT}


def whole_run(clip: str, options: dict[str, Any], settings: dict[str, Any]) -> dict[str, float]:
    """Return the metrics of a whole run, in the units of metrics.json."""
    with tempfile.TemporaryDirectory() as folder:
        given = {"preset": "test", "settings": settings, "quiet": True, **options}
        run = minislam.run(f"synth:{clip}", f"{folder}/run", **given)
        metrics = run.folder.read_metrics()
        return {name: metrics[name] for name in SHOWN if metrics.get(name) is not None}


def tracking_alone(
    clip: str, options: dict[str, Any], settings: dict[str, Any]
) -> dict[str, float]:
    """Return the ATE of the keyframes before and after the final adjustment [cm]."""
    sequence = open_sequence(f"synth:{clip}", InputOptions(**options))
    before, after = errors(sequence, with_settings(preset("test"), settings).tracking, False)
    return {"before_cm": before, "after_cm": after}


def measure(part: str) -> None:
    """Measure the rows of a part that are not stored yet."""
    path = RESULTS / f"{part}.json"
    stored = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    command = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    stored.setdefault("command", f"python -m tests.benchmarks.bench_course {part}")
    stored.setdefault("commit", commit.strip())
    stored.setdefault("input", {"preset": "test", **COMMON[part], **INPUT[part]})
    rows = stored.setdefault("rows", {})
    for clip in CLIPS[part]:
        for row, settings in ROWS[part].items():
            if clip in rows.setdefault(row, {}):
                continue
            measured = tracking_alone if part == "prior" else whole_run
            found = measured(clip, INPUT[part], COMMON[part] | settings)
            rows[row][clip] = {name: round(value, 3) for name, value in found.items()}
            print(part, row, clip, rows[row][clip], flush=True)
            atomic_write(path, (json.dumps(stored, indent=1) + "\n").encode())


def main() -> None:
    """Measure one part."""
    parser = argparse.ArgumentParser(description="measure what notebooks 08 and 10 show")
    parser.add_argument("part", choices=ROWS)
    torch.set_num_threads(1)
    measure(parser.parse_args().part)


if __name__ == "__main__":
    main()
