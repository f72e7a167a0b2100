"""Random mutations of a valid file per parser: finite values, or InputError."""

import io
import json
import random
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.config import SlamConfig, settings_in, with_settings
from minislam.data.calibration import read_calibration
from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.data.files import read_json
from minislam.data.images import encode_jpeg, encode_png, read_color
from minislam.data.ply import GaussianArrays, encode_ply, read_ply
from minislam.data.raw_images import VideoImages
from minislam.data.trajectory import read_trajectory
from minislam.data.tum import read_tum_folder
from minislam.errors import InputError
from minislam.priors.files import read_array
from tests.recordings import picture, save, video

MUTATIONS = 500
OF_FILES = 250  # mutations of what is read from the disk
_TEXT_PIECES = [
    "nan", "inf", "-", "1e400", "#", "\n", " ", "\t", ",", "\0", "0", "-1", "\ufeff", "é", "1_0",
]  # fmt: skip


def mutated_text(text: str, source: random.Random) -> str:
    """Return the text with one to three pieces deleted, doubled or replaced."""
    for _ in range(source.randint(1, 3)):
        start = source.randrange(len(text) + 1)
        end = min(len(text), start + source.randint(0, 12))
        piece = source.choice([*_TEXT_PIECES, "", text[start:end] * 2])
        text = text[:start] + piece + text[end:]
    return text


def mutated_bytes(content: bytes, source: random.Random) -> bytes:
    """Return the bytes with one to three bytes changed, ranges removed or doubled."""
    changed = bytearray(content)
    for _ in range(source.randint(1, 3)):
        start = source.randrange(max(len(changed), 1))
        end = start + source.randint(1, 8)
        random_bytes = bytes(source.randrange(256) for _ in range(end - start))
        changed[start:end] = source.choice([b"", random_bytes, changed[start:end] * 2])
    return bytes(changed)


def check_list(path: Path) -> None:
    recording = read_tum_folder(path.parent)
    stamps = recording.timestamps
    assert np.isfinite(stamps).all() and (np.diff(stamps) > 0).all()
    assert len(stamps) == len(recording.images)


def check_trajectory(path: Path) -> None:
    trajectory = read_trajectory(path)
    assert np.isfinite(trajectory.T_world_camera).all()
    assert (np.diff(trajectory.timestamps) > 0).all()


def check_calibration(path: Path) -> None:
    camera = read_calibration(path).camera_for(64, 48)
    values = [camera.fx, camera.fy, camera.cx, camera.cy]
    assert np.isfinite(values).all() and camera.fx > 0


LIST = "# timestamp filename\n1.5 rgb/1.5.png\n2.25 rgb/2.25.png\n3.0 rgb/3.0.png\n"
TRAJECTORY = "# timestamp ...\n1.0 0.1 0.2 0.3 0 0 0.6 0.8\n2.0 1.1 0.2 0.3 1 0 0 0\n"
CALIBRATION = "# fx fy cx cy\n50.5 50.5 31.5 23.5 64 48 0.1 -0.2 0.001 0.002 0.05\n"


@pytest.mark.parametrize(
    "check, valid",
    [(check_list, LIST), (check_trajectory, TRAJECTORY), (check_calibration, CALIBRATION)],
)
def test_mutated_text_files(check: Callable[[Path], None], valid: str, tmp_path: Path):
    source, refused = random.Random(0), 0
    path = tmp_path / "rgb.txt"
    for stamp in ("1.5", "2.25", "3.0"):
        save(tmp_path / f"rgb/{stamp}.png", picture(0, 8, 8))
    path.write_text(valid, encoding="utf-8")
    check(path)
    for _ in range(MUTATIONS):
        path.write_text(mutated_text(valid, source), encoding="utf-8")
        try:
            check(path)
        except InputError:
            refused += 1
    assert 0 < refused < MUTATIONS


def test_mutated_maps(tmp_path: Path):
    values = np.random.default_rng(0).normal(size=(4, 14)).astype(np.float32)
    arrays = GaussianArrays(values[:, :3], values[:, 3:6], values[:, 6:10], values[:, 10],
                            values[:, 11:])  # fmt: skip
    valid, source, refused = encode_ply(arrays), random.Random(0), 0
    for _ in range(MUTATIONS):
        (tmp_path / "map.ply").write_bytes(mutated_bytes(valid, source))
        try:
            read = read_ply(tmp_path / "map.ply")
        except InputError:
            refused += 1
            continue
        for array in (read.means, read.log_scales, read.quats_wxyz, read.colors):
            assert np.isfinite(array).all()
    assert 0 < refused < MUTATIONS


# Whole files on the disk


def check_settings(path: Path) -> None:
    config = with_settings(SlamConfig(), settings_in(read_json(path)))
    assert isinstance(config, SlamConfig)


def check_array(path: Path) -> None:
    assert read_array(path, "depth").dtype.kind == "f"


def check_checkpoint(path: Path) -> None:
    assert isinstance(read_checkpoint(path), dict | list | str | int | float | None)


def check_picture(path: Path) -> None:
    image = read_color(path)
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3


def settings_file() -> bytes:
    return json.dumps(asdict(SlamConfig())).encode()


def array_file() -> bytes:
    file = io.BytesIO()
    np.save(file, np.linspace(1, 2, 12, dtype=np.float32).reshape(3, 4))
    return file.getvalue()


def checkpoint_file(folder: Path) -> bytes:
    write_checkpoint(folder / "whole.npz", {"a": [torch.ones(3), None], "b": {"c": 1.5}})
    return (folder / "whole.npz").read_bytes()


@pytest.mark.filterwarnings("ignore:.*may be damaged")
@pytest.mark.parametrize(
    ("check", "make", "name"),
    [
        (check_settings, lambda _: settings_file(), "a.json"),
        (check_array, lambda _: array_file(), "a.npy"),
        (check_checkpoint, checkpoint_file, "a.npz"),
        (check_picture, lambda _: encode_png(picture(3)), "a.png"),
        (check_picture, lambda _: encode_jpeg(picture(3), 48), "a.jpg"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_mutated_files(check: Callable[[Path], None], make, name: str, tmp_path: Path):
    valid, source, refused = make(tmp_path), random.Random(0), 0
    path = tmp_path / name
    path.write_bytes(valid)
    check(path)
    for _ in range(OF_FILES):
        content = mutated_bytes(valid, source)
        path.write_bytes(content[: source.choice([len(content), source.randrange(len(content))])])
        try:
            check(path)
        except InputError:
            refused += 1
    assert 0 < refused <= OF_FILES


def test_mutated_videos(tmp_path: Path):
    valid, source = video(tmp_path / "a.mp4", 6, (48, 32)).read_bytes(), random.Random(0)
    for _ in range(40):
        (tmp_path / "a.mp4").write_bytes(mutated_bytes(valid, source))
        try:
            images = VideoImages(tmp_path / "a.mp4", 20)
        except InputError:
            continue
        assert np.isfinite(images.timestamps).all() and len(images) <= 20
        for index in range(len(images)):
            assert images.read(index).dtype == np.uint8
