"""Print the accuracy of tracking on a learned flow: an oracle in the place of DROID's network.

python -m tests.benchmarks.bench_learned            about four minutes; --preset paper: six
"""

import argparse
from dataclasses import replace

import torch

from minislam.config import PRESETS, preset
from tests.tracking import oracle

CLIP, SEED, FRAMES = "umbrella", 7, 40


def main() -> None:
    """Print keyframes, lost frames and ATE for every oracle."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--preset", choices=list(PRESETS), default="laptop")
    parser.add_argument("--no-depth", action="store_true", help="without a depth prior")
    parser.add_argument("--warm-up", type=int, help="keyframes of the start")
    options = parser.parse_args()
    torch.set_num_threads(1)
    config = preset(options.preset)
    keyframes = options.warm_up or config.tracking.warmup_keyframes
    tracking = replace(config.tracking, warmup_keyframes=keyframes)
    clip = oracle.plain_clip(CLIP, SEED, FRAMES)
    for name, skill in oracle.SKILLS.items():
        flow = oracle.OracleFlow(clip, skill, config.networks.droid)
        tracker = oracle.track(clip, flow, tracking, with_depth=not options.no_depth)
        of_keyframes, of_all = oracle.errors(clip, tracker)
        lost = sum(not frame.status.is_followed for frame in tracker.tracked)
        found = f"{len(tracker.keyframes)} keyframes, {lost} frames lost, ATE of keyframes "
        print(f"{name:20s} {found}{of_keyframes:.2f} cm, of all {of_all:.2f} cm", flush=True)


if __name__ == "__main__":
    main()
