"""Small recordings on disk for the tests of the readers."""

from pathlib import Path

import cv2
import numpy as np


def picture(number: int, width: int = 48, height: int = 32) -> np.ndarray:
    """Return a smooth (H, W, 3) uint8 RGB picture that differs from number to number."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    channels = [u * 200 / width, v * 200 / height, np.full_like(u, 10 * number % 250)]
    return np.stack(channels, -1).astype(np.uint8)


def save(path: Path, image: np.ndarray) -> Path:
    """Write an image (RGB if it has three channels) with OpenCV, independently of the package."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image
    path.write_bytes(cv2.imencode(path.suffix, bgr)[1].tobytes())
    return path


def tum_folder(folder: Path, count: int = 6, size: tuple[int, int] = (48, 32)) -> Path:
    """Write a TUM RGB-D folder with all the extras that a synthetic sequence has."""
    width, height = size
    rgb, depth, truth = [], [], ["# ground truth"]
    for number in range(count):
        stamp = f"{100 + number / 10:.6f}"
        save(folder / f"rgb/{stamp}.png", picture(number, width, height))
        save(folder / f"depth/{stamp}.png", np.full((height, width), 5000 + number, np.uint16))
        mask = np.zeros((height, width), np.uint8)
        mask[:, : width // 2] = 255
        save(folder / f"masks/{stamp}.png", mask)
        save(folder / f"static/{stamp}.png", picture(20, width, height))
        rgb.append(f"{stamp} rgb/{stamp}.png")
        depth.append(f"{stamp} depth/{stamp}.png")
        truth.append(f"{stamp} {number} {number**2} 0 0 0 0 1")
    for number in range(2):
        save(folder / f"novel/{number}.png", picture(30 + number, width, height))
    poses = "".join(f"{number} 0 {number} 1 0 0 0 1\n" for number in range(2))
    (folder / "novel/poses.txt").write_text(poses)
    (folder / "rgb.txt").write_text("# color images\n" + "\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    (folder / "calibration.txt").write_text(f"# fx fy cx cy\n40 41 23 16 {width} {height}\n")
    return folder


def video(path: Path, count: int = 12, size: tuple[int, int] = (96, 64), rate: float = 10) -> Path:
    """Write a video; frame k is grey with value 20 k and has a red upper left corner."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, size)
    for number in range(count):
        frame = np.full((size[1], size[0], 3), 20 * number, np.uint8)
        frame[:20, :20] = (0, 0, 255)
        writer.write(frame)
    writer.release()
    return path
