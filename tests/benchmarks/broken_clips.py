"""Clips that break a run, each made from rendered ones: glued, smeared, mirrored, frozen, ...

The camera moves twice as fast as in a usual clip, so that 70 frames hold the warm-up and a break.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from data_synth import Intrinsics, SyntheticFrame, default_intrinsics, render_frame, scene
from data_synth.sequence import in_order
from tests.benchmarks.incidents import Clip

Frames = list[SyntheticFrame]

FRAMES = 70
PACE = 2  # frames of the usual clip per frame
BREAK = 42  # first broken frame
BROKEN = 10  # frames, of a break that passes
SIZE = (160, 120)  # px, width and height


def base(name: str, seed: int, size: tuple[int, int] = SIZE, frames: int = FRAMES) -> Frames:
    """Render the unbroken frames of a scene."""
    view, k = scene(name, seed), default_intrinsics(size)
    return list(in_order(lambda i: render_frame(view, k, PACE * i), frames))


def _images(frames: Frames, change: Callable[[int, np.ndarray], np.ndarray], span: range) -> Frames:
    """Return the frames with the images of a span changed; truth and depth stay."""
    return [
        replace(frame, rgb=np.ascontiguousarray(change(index, frame.rgb)))
        if index in span
        else frame
        for index, frame in enumerate(frames)
    ]


def _warped(frame: SyntheticFrame, change: Callable[[np.ndarray], np.ndarray]) -> SyntheticFrame:
    """Return a frame with image and depth changed in the same way, as a depth network would."""
    rgb, depth = change(frame.rgb), change(frame.depth)
    return replace(frame, rgb=np.ascontiguousarray(rgb), depth=np.ascontiguousarray(depth))


TAIL, SPAN = range(BREAK, FRAMES), range(BREAK, BREAK + BROKEN)


def _noise(sigma: float) -> Callable[[int, np.ndarray], np.ndarray]:
    def change(index: int, image: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(index).standard_normal(image.shape)
        return np.clip(image + 255 * sigma * noise, 0, 255).astype(np.uint8)

    return change


def _exposure(index: int, image: np.ndarray) -> np.ndarray:
    gain = np.exp(np.random.default_rng(index).uniform(-0.7, 0.7))
    return np.clip(gain * image.astype(np.float32), 0, 255).astype(np.uint8)


def _smear(index: int, image: np.ndarray) -> np.ndarray:
    length = image.shape[1] // 5
    angle = np.random.default_rng(index).uniform(0, np.pi)
    kernel = np.zeros((length, length), np.float32)
    reach = 0.5 * (length - 1) * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(np.round(0.5 * (length - 1) + s * reach).astype(int).tolist()) for s in (-1, 1)]
    cv2.line(kernel, *ends, 1.0)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def _shown(frames: Frames, order: list[int]) -> Frames:
    return [frames[index] for index in order]


def _zoomed(factor: float, wide: float | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change of an image: magnified about its middle, in x by another factor if given."""

    def change(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        matrix = np.diag([wide or factor, factor]).astype(np.float32)
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        affine = np.column_stack([matrix, middle - matrix @ middle])
        return cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REFLECT)

    return change


def _covering(frames: Frames, share: float) -> Frames:
    """Cover a share of the view with a textured thing that moves on its own, from BREAK on.

    It is nearer than anything else, and a depth network would see it.
    """
    rng = np.random.default_rng(5)
    height, width = frames[0].rgb.shape[:2]
    coarse = rng.integers(0, 255, (height // 3, width // 2, 3), dtype=np.uint8)
    cloth = cv2.resize(coarse, (3 * width, 2 * height), interpolation=cv2.INTER_CUBIC)

    near = 0.5 * min(float(frame.depth.min()) for frame in frames)

    def covered(index: int) -> SyntheticFrame:
        step = index - BREAK
        x, y = 5 * step, int(20 + 15 * np.sin(0.4 * step))
        cut = int(min(1.0, 0.2 + 0.2 * step) * share * width)
        rgb, depth = frames[index].rgb.copy(), frames[index].depth.copy()
        rgb[:, :cut], depth[:, :cut] = cloth[y : y + height, x : x + cut], near
        return replace(frames[index], rgb=rgb, depth=depth)

    return [*frames[:BREAK], *(covered(index) for index in TAIL)]


def _turning(name: str, seed: int, frames: Frames, size: tuple[int, int]) -> Frames:
    """From BREAK on the camera only turns, by a degree and a half a frame."""
    view, k = scene(name, seed), default_intrinsics(size)
    start = frames[BREAK].T_world_camera

    def turned(index: int) -> SyntheticFrame:
        angle = np.radians(1.5) * (index - BREAK)
        turn = np.eye(4)
        cos, sin = np.cos(angle), np.sin(angle)
        turn[[0, 0, 2, 2], [0, 2, 0, 2]] = cos, sin, -sin, cos
        held = replace(view, path=lambda time: start @ turn)
        return render_frame(held, k, PACE * index)

    return [*frames[:BREAK], *in_order(lambda i: turned(BREAK + i), len(frames) - BREAK)]


def clips(
    name: str, seed: int, frames: Frames, other: Frames, size: tuple[int, int] = SIZE
) -> dict[str, tuple[Frames, bool, float]]:
    """Return clip name -> frames, whether the truth holds across the break, factor of the focal.

    `other` are the frames of another scene.
    """
    n, b, e = len(frames), BREAK, BREAK + BROKEN
    back = [*range(b), *range(e + 8, b, -1), *range(e + 1, n)][:n]
    rng = np.random.default_rng(0)
    shuffled = [*range(b), *(b + rng.permutation(n - b)).tolist()]

    def tail(change: Callable[[np.ndarray], np.ndarray]) -> Frames:
        return [*frames[:b], *(_warped(frame, change) for frame in frames[b:])]

    def gray(level: int, span: range) -> Frames:
        return _images(frames, lambda i, image: np.full_like(image, level), span)

    ramp = [1 + 0.5 * (i - b) / BROKEN for i in SPAN]
    zoom = [_warped(frames[i], _zoomed(min(1.5, f))) for i, f in zip(SPAN, ramp, strict=True)]
    zoom += [_warped(frame, _zoomed(1.5)) for frame in frames[e:]]
    return {
        "glued": ([*frames[:b], *other[: n - b]], False, 1.0),
        "jump back": (_shown(frames, [*range(b), *range(6, 6 + n - b)]), True, 1.0),
        "jump on": (_shown(frames, [*range(b - 14), *range(b + 4, n)]), True, 1.0),
        "reversed piece": (_shown(frames, back), True, 1.0),
        "forth and back": (_shown(frames, [*range(b), *range(b, b - n + b, -1)]), True, 1.0),
        "shuffled": (_shown(frames, shuffled), True, 1.0),
        "every 4th": (_shown(frames, [*range(0, 30), *range(30, n, 4)]), True, 1.0),
        "every 2nd": (_shown(frames, list(range(0, n, 2))), True, 1.0),
        "smear": (_images(frames, _smear, SPAN), True, 1.0),
        "smear to the end": (_images(frames, _smear, TAIL), True, 1.0),
        "focal x 1.4": (frames, True, 1.4),
        "focal x .7": (frames, True, 0.7),
        "focal x 2": (frames, True, 2.0),
        "pure turn": (_turning(name, seed, frames, size), True, 1.0),
        "grey wall": (gray(130, SPAN), True, 1.0),
        "grey wall to the end": (gray(130, TAIL), True, 1.0),
        "black": (gray(0, SPAN), True, 1.0),
        "frozen": (_shown(frames, [*range(b), *[b] * BROKEN, *range(e, n)]), True, 1.0),
        "noise .1": (_images(frames, _noise(0.1), TAIL), True, 1.0),
        "noise .3": (_images(frames, _noise(0.3), TAIL), True, 1.0),
        "exposure": (_images(frames, _exposure, TAIL), True, 1.0),
        "cover .6": (_covering(frames, 0.6), True, 1.0),
        "cover .9": (_covering(frames, 0.9), True, 1.0),
        "zoom": ([*frames[:b], *zoom], True, 1.0),
        "stretched": (tail(_zoomed(1.0, 1.4)), True, 1.0),
        "mirrored": (tail(lambda image: image[:, ::-1]), False, 1.0),
        "upside down": (tail(lambda image: image[::-1, ::-1]), True, 1.0),  # a camera rolled over
        "unbroken": (frames, True, 1.0),
    }


def clip(name: str, frames: Frames, size: tuple[int, int] = SIZE, factor: float = 1.0) -> Clip:
    """Return frames as a sequence, the focal length of its camera wrong by a factor."""
    k = default_intrinsics(size)
    k = Intrinsics(factor * k.fx, factor * k.fy, k.cx, k.cy, k.width, k.height)
    return Clip(name, frames, k)
