"""Cover the images of a folder as films and dash cameras do, or bend them as a wide lens does.

    python -m tests.benchmarks.covered FOLDER OUT KIND [IMAGES]

KIND: `bars` (letterbox), `logo` (clock, label, a pale word across the image), `spotted` or `plain`
(a dashboard over the lower fifth, textured or black with a few lines), `barrel` (k1 = -.25 of a
lens of fr1's focal length; run OUT/rgb, which has no calibration). OUT is a new folder with the
first IMAGES images and what lies beside them.
"""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from minislam.data.images import list_images

FONT = cv2.FONT_HERSHEY_SIMPLEX
WHITE, GREY = (255, 255, 255), (120, 120, 120)
Image = np.ndarray  # (H, W, 3) uint8 BGR


def bars(image: Image) -> Image:
    side = round(0.12 * len(image))
    image[:side] = image[-side:] = 0
    return image


def logo(image: Image) -> Image:
    size = image.shape[1] / 640
    word = image.copy()
    _write(word, "NOBODY'S CLIP", 0.14, 0.54, 2.0 * size)
    image = cv2.addWeighted(word, 0.4, image, 0.6, 0)
    height, width = image.shape[:2]
    corners = (int(0.81 * width), int(0.04 * height)), (int(0.97 * width), int(0.15 * height))
    cv2.rectangle(image, *corners, (0, 0, 200), -1)
    for text, x, y in (("LIVE", 0.83, 0.12), ("00:12:40", 0.03, 0.08), ("CAM 21", 0.03, 0.92)):
        _write(image, text, x, y, size)
    return image


def spotted(image: Image) -> Image:
    spots = np.random.default_rng(0).uniform(0, 255, image.shape).astype(np.uint8)
    spots = cv2.GaussianBlur(spots, (0, 0), 5 * image.shape[1] / 640)
    return _over(image, cv2.normalize(spots, None, 20, 200, cv2.NORM_MINMAX))


def plain(image: Image) -> Image:
    height, width = image.shape[:2]
    board = np.full_like(image, 36)
    for x in range(0, width, width // 7):
        cv2.line(board, (x, int(0.75 * height)), (x + width // 10, height), GREY, 3)
    middle, half_axes = (width // 2, int(1.04 * height)), (int(0.52 * width), int(0.2 * height))
    cv2.ellipse(board, middle, half_axes, 0, 0, 360, GREY, 3)
    return _over(image, board)


def barrel(image: Image) -> Image:
    height, width = image.shape[:2]
    focal, middle = 0.81 * width, np.array([width / 2, height / 2], np.float32)
    seen = (np.indices((width, height), np.float32).T - middle) * 0.8 / focal  # no empty corners
    ray = seen
    for _ in range(20):
        ray = seen / (1 - 0.25 * (ray**2).sum(-1, keepdims=True))
    return cv2.remap(image, ray * focal + middle, None, cv2.INTER_LINEAR)


def _over(image: Image, board: Image) -> Image:
    height, width = image.shape[:2]
    mask, half_axes = np.zeros((height, width), np.uint8), (int(0.59 * width), int(0.27 * height))
    cv2.ellipse(mask, (width // 2, int(1.04 * height)), half_axes, 0, 0, 360, 1, -1)
    return np.where(mask[..., None] > 0, board, image)


def _write(image: Image, text: str, x: float, y: float, size: float) -> None:
    at = int(x * image.shape[1]), int(y * image.shape[0])
    cv2.putText(image, text, at, FONT, size, WHITE, max(2, round(3 * size)), cv2.LINE_AA)


KINDS = {"bars": bars, "logo": logo, "spotted": spotted, "plain": plain, "barrel": barrel}


def main(folder: str, out: str, kind: str, images: str = "100") -> None:
    shutil.copytree(folder, out, ignore=shutil.ignore_patterns("depth", "depth.txt"))
    inside = next(p for p in (Path(out) / n for n in ("rgb", "images", "")) if list_images(p))
    for number, path in enumerate(list_images(inside)):
        if number < int(images):
            cv2.imwrite(str(path), KINDS[kind](cv2.imread(str(path))))
        else:
            path.unlink()
    index = Path(out) / "rgb.txt"
    if index.exists():
        rows = [row for row in index.read_text().splitlines() if row[:1] != "#"]
        index.write_text("\n".join(rows[: int(images)]) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
