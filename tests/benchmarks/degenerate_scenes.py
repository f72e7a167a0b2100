"""Run clips that no SLAM likes: is each declared, or followed, or silently wrong?

    python -m tests.benchmarks.degenerate_scenes [NAME:SEED] [CLIP ...]

Whole runs of the command line, without a depth prior, `--preset test`, on folders of 24 images of
160x120. Declared: exit code 1 or 3, or a warning. Fine: the ATE of all frames is below a tenth of
that of the best straight line. Up to 40 s a clip.
"""

import contextlib
import io
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from data_synth import default_intrinsics, render_frame, scene
from data_synth.sequence import in_order
from minislam.cli.main import main as command_line
from minislam.data.trajectory import write_trajectory
from minislam.records import Trajectory
from tests.brief import plots_left_out
from tests.recordings import save

SIZE = (160, 120)  # px, width and height
FRAMES = 24
PACE = 4  # frames of the usual clip per frame: the way is no straight line
FINE = 0.1  # of the ATE of the straight line
OPTIONS = "--preset test --depth none --workers 1 --checkpoint_fraction 0 -q".split()
Image = np.ndarray  # (H, W, 3) uint8
Shot = tuple[Image, np.ndarray]  # with the pose (4, 4) of its camera
Change = Callable[[int, Image], Image]


def shots(name: str, seed: int, count: int, pace: int = PACE, turn: float = 0.0) -> list[Shot]:
    """Render frames of a clip; with `turn` [deg] a frame the camera stays and turns."""
    view, k = scene(name, seed), default_intrinsics(SIZE)

    def shot(index: int) -> Shot:
        if not turn:
            frame = render_frame(view, k, pace * index)
            return frame.rgb, frame.T_world_camera
        angle, pose = np.radians(turn * index), np.eye(4)
        pose[[0, 0, 2, 2], [0, 2, 0, 2]] = (
            np.cos(angle),
            np.sin(angle),
            -np.sin(angle),
            np.cos(angle),
        )
        pose = view.path(0.0) @ pose
        frame = render_frame(replace(view, path=lambda time: pose), k, index)
        return frame.rgb, pose

    return list(in_order(shot, count))


def gain(factor: float) -> Change:
    """Return what makes an image darker or brighter."""
    return lambda _, image: np.clip(factor * image.astype(np.float32), 0, 255).astype(np.uint8)


def zoomed(factor: float) -> Callable[[Image], Image]:
    """Return what magnifies an image about its middle."""
    middle = (np.array(SIZE) - 1) / 2
    affine = np.column_stack([factor * np.eye(2), (1 - factor) * middle]).astype(np.float32)
    return lambda image: cv2.warpAffine(image, affine, SIZE, borderMode=cv2.BORDER_REFLECT)


def blurred(_: int, image: Image) -> Image:
    """Smear an image over 25 px."""
    return cv2.blur(image, (25, 3))


def noise(seed: int) -> Image:
    """Return an image of noise."""
    return np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def wall(index: int, _: Image) -> Image:
    """Return a grey wall with the noise of a sensor."""
    grain = np.random.default_rng(index).normal(0, 3, (SIZE[1], SIZE[0], 3))
    return np.clip(128 + grain, 0, 255).astype(np.uint8)


def cloth(index: int, _: Image) -> Image:
    """Return a texture that fills the view and moves on its own."""
    coarse = np.random.default_rng(5).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    large = cv2.resize(coarse, (480, 360), interpolation=cv2.INTER_CUBIC)
    return large[3 * index : 3 * index + SIZE[1], 5 * index : 5 * index + SIZE[0]]


def boxes(*places: tuple[int, int, int, int]) -> Change:  # left, top, width, height px
    """Return what draws chequered boxes over an image."""

    def change(_: int, image: Image) -> Image:
        image = image.copy()
        for left, top, width, height in places:
            v, u = np.mgrid[:height, :width]
            chequered = 255 * ((u // 4 + v // 4) % 2).astype(np.uint8)
            image[top : top + height, left : left + width] = chequered[..., None]
        return image

    return change


def bars(_: int, image: Image) -> Image:
    """Black out the upper and the lower eighth."""
    image = image.copy()
    image[: SIZE[1] // 8] = image[-SIZE[1] // 8 :] = 0
    return image


def clips(name: str, seed: int) -> dict[str, tuple[list[Shot] | Callable[[], list[Shot]], float]]:
    """Return clip -> shots, and the factor by which its focal length is wrong."""
    good, n = shots(name, seed, FRAMES), FRAMES

    def on(change: Change, frames: range = range(n)) -> list[Shot]:
        return [(change(i, a), p) if i in frames else (a, p) for i, (a, p) in enumerate(good)]

    def order(*numbers: int) -> list[Shot]:
        return [good[number] for number in numbers]

    def upright(shot: Shot) -> Shot:
        turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        return np.rot90(shot[0], -1), shot[1] @ turn.T

    rng = np.random.default_rng(0)
    made = {
        "plain": good, "reversed": good[::-1], "vertical": [upright(shot) for shot in good],
        "three times": order(*(k for k in range(12) for _ in range(3))),
        "4 black": on(gain(0), range(10, 14)), "6 black at the end": on(gain(0), range(18, 24)),
        "flash": on(gain(1e9), range(12, 13)), "4 blurred": on(blurred, range(10, 14)),
        "black first": on(gain(0), range(1)), "4 black first": on(gain(0), range(4)),
        "fade in": [(gain(min(1, i / 6))(i, a), p) for i, (a, p) in enumerate(good)],
        "slate first": on(lambda i, _: noise(7), range(3)),
        "exposure": [(gain((0.45, 1.5)[i % 2])(i, a), p) for i, (a, p) in enumerate(good)],
        "dark step": on(gain(0.3), range(12, n)),
        "jump cut": lambda: good[:14] + shots("static", 5, 14),
        "jump cut 8 + 20": lambda: good[:8] + shots("static", 5, 20),
        "jump cut 20 + 8": lambda: good[:20] + shots("static", 5, 8),
        "jump cut 30 + 30": lambda: shots(name, seed, 30) + shots("static", 5, 30),
        "mirrored": on(lambda _, a: a[:, ::-1], range(12, n)),
        "cloth": on(cloth, range(10, 16)), "grey wall": on(wall),
        "noise": on(lambda i, _: noise(i)),
        "standing": order(*[0] * 20), "turning": lambda: shots(name, seed, 20, turn=1.5),
        "standing, movers": lambda: [(a, good[0][1]) for a, _ in shots(name, seed, 20, turn=1e-9)],
        "black bars": on(bars), "overlay": on(boxes((10, 10, 60, 24), (100, 90, 50, 20))),
        "watermark": on(boxes((140, 105, 12, 8))),
        "zoom": [(zoomed(1.015**i)(a), p) for i, (a, p) in enumerate(good)],
        "5 frozen": order(*range(10), *[9] * 5, *range(15, n)),
        "2 frozen": order(*range(10), *[9] * 2, *range(12, n)),
        "every 4th doubled": order(*(k - k % 4 % 3 // 2 for k in range(n))),
        "shuffled": order(*rng.permutation(n)),
        "every 8th": lambda: shots(name, seed, 12, 2 * PACE),
        "3 frames": order(0, 8, 16), "2 frames": order(0, 8), "1 frame": order(0), "none": [],
    }  # fmt: skip
    wrong = {"focal x 1.4": 1.4, "focal x .7": 0.7}
    return {k: (v, 1.0) for k, v in made.items()} | {k: (good, f) for k, f in wrong.items()}


def write(folder: Path, clip: list[Shot], factor: float) -> None:
    """Write a TUM folder with the truth."""
    rows = []
    for number, (image, _) in enumerate(clip):
        save(folder / f"rgb/{number:02d}.png", np.ascontiguousarray(image))
        rows.append(f"{number / 30:.6f} rgb/{number:02d}.png\n")
    (folder / "rgb.txt").write_text("".join(rows))
    if clip:
        poses = np.array([pose for _, pose in clip])
        write_trajectory(folder / "groundtruth.txt", Trajectory(np.arange(len(clip)) / 30, poses))
        k, height = default_intrinsics(SIZE), clip[0][0].shape[0]
        centre = (k.cx, k.cy) if height == SIZE[1] else (k.cy, k.cx)
        numbers = (factor * k.fx, factor * k.fy, *centre)
        (folder / "calibration.txt").write_text(" ".join(f"{number:.9g}" for number in numbers))


def row(label: str, clip: list[Shot], factor: float) -> tuple[str, str]:
    """Run a clip; return the verdict and what is known."""
    with tempfile.TemporaryDirectory() as root, plots_left_out():
        source, out = Path(root) / "clip", Path(root) / "out"
        source.mkdir()
        write(source, clip, factor)
        with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
            code = command_line(["run", str(source), "-o", str(out), *OPTIONS])
        lines = said.getvalue().splitlines()
        said = [line for line in lines if line.startswith(("WARNING", "minislam: "))]
        said = [line for line in said if "without a depth prior" not in line]  # of every run
        facts = {}
        if (out / "metrics.json").exists():
            facts = json.loads((out / "metrics.json").read_text())
        ate, line = facts.get("ate_all_cm"), facts.get("ate_straight_line_cm")
    is_fine = code == 0 and None not in (ate, line) and ate < FINE * line
    verdict = "declared" if code or said else "fine" if is_fine else "SILENT"
    if is_fine and said:
        verdict = "fine, warned"
    known = f"{ate:.2f} of {line:.2f} cm" if None not in (ate, line) else ""
    return verdict, f"exit {code}, {known} {'; '.join(dict.fromkeys(said))[:400]}"


def main() -> None:
    """Print one row per clip."""
    torch.set_num_threads(1)
    words, score = sys.argv[1:], Counter[str]()
    name, seed = "ball", 3
    if words and ":" in words[0]:
        name, _, number = words.pop(0).partition(":")
        seed = int(number)
    for label, (clip, factor) in clips(name, seed).items():
        if not words or label in words:
            made = clip() if callable(clip) else clip
            verdict, facts = row(label, made, factor)
            score[verdict] += 1
            print(f"{label:18s} {verdict:12s} {facts}", flush=True)
    if not score:
        raise SystemExit(f"no clip is called {words}")
    print(dict(score))


if __name__ == "__main__":
    main()
