"""What parts of the tracker are worth: the disparity prior with its mask, and closing loops.

    python -m tests.benchmarks.bench_ablations prior|loop [NAME:SEED ...]

Tracking alone, at 320x240 with the simulated depth prior. The ATE of the keyframes in cm, before
and after the final adjustment. About 20 s a column, some minutes where a loop of 400 frames is
walked.
"""

import argparse
from dataclasses import replace

import torch

from minislam.data.sequence import open_sequence
from minislam.tracking.config import TrackingConfig
from tests.benchmarks.bench_movers import SEED, SEQUENCES, errors

KEPT = TrackingConfig(lambda_disparity_prior=0.0005, final_prior=True)
OFF = TrackingConfig(lambda_disparity_prior=0.0005)
COLUMNS = {
    # Rows (i) to (iv) of the paper's supplement, Tab. "Ablation Study on Disparity Regularization".
    "prior": {
        "(i) no M, prior kept": replace(KEPT, prior_mask=False),
        "(ii) M, prior kept": KEPT,
        "(iii) no M, prior off": replace(OFF, prior_mask=False),
        "(iv) M, prior off": OFF,
    },
    "loop": {
        "neither": TrackingConfig(loop_closure=False, global_interval=0),
        "online global BA": TrackingConfig(loop_closure=False),
        "loop closure": TrackingConfig(global_interval=0),
        "both": TrackingConfig(),
    },
}
SEQUENCES_OF = {"prior": SEQUENCES, "loop": ("loop",)}


def main() -> None:
    """Print one row per sequence."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=COLUMNS)
    parser.add_argument("names", nargs="*", metavar="NAME:SEED")
    given = parser.parse_args()
    torch.set_num_threads(1)
    columns = COLUMNS[given.part]
    print(f"{'sequence':<14}" + "".join(f"{heading:>24}" for heading in columns))
    for name in given.names or [f"{name}:{SEED}" for name in SEQUENCES_OF[given.part]]:
        sequence = open_sequence(f"synth:{name}")
        print(f"{name:<14}", end="")
        for settings in columns.values():
            before, after = errors(sequence, settings, masks=False)
            print(f"{f'{before:.2f} -> {after:.2f}':>24}", end="", flush=True)
        print()


if __name__ == "__main__":
    main()
